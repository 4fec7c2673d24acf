"""The ``chronoscene`` command; the module of a subcommand is imported only when it is called."""

from __future__ import annotations

import importlib
import sys

import click

from chronoscene import __version__
from chronoscene.errors import ChronoSceneError
from chronoscene.io.processes import stoppable
from chronoscene.io.staging import disk_full
from chronoscene.io.wording import printable_lines

COMMANDS = {
    "all": "chronoscene.cli.runs.all:command",
    "bench": "chronoscene.cli.runs.bench:command",
    "changes": "chronoscene.cli.runs.changes:command",
    "check-method": "chronoscene.cli.methods.check_method:check",
    "compare": "chronoscene.cli.report.compare:command",
    "compress": "chronoscene.cli.runs.compress:command",
    "convert": "chronoscene.cli.scenes.convert:command",
    "doctor": "chronoscene.cli.doctor:command",
    "download": "chronoscene.cli.scenes.download:command",
    "edit": "chronoscene.cli.scenes.edit:command",
    "export": "chronoscene.cli.runs.export:command",
    "leakage": "chronoscene.cli.runs.leakage:command",
    "leaderboard": "chronoscene.cli.report.leaderboard:leaderboard_command",
    "mark": "chronoscene.cli.scenes.mark:command",
    "methods": "chronoscene.cli.methods.methods:command",
    "new-method": "chronoscene.cli.methods.check_method:new",
    "page": "chronoscene.cli.runs.page:command",
    "register": "chronoscene.cli.scenes.register:command",
    "render": "chronoscene.cli.runs.render:command",
    "score": "chronoscene.cli.report.results:score",
    "score-images": "chronoscene.cli.runs.score_images:command",
    "split": "chronoscene.cli.scenes.split:command",
    "stats": "chronoscene.cli.scenes.stats:command",
    "study": "chronoscene.cli.runs.study:command",
    "submit": "chronoscene.cli.report.leaderboard:submit_command",
    "survey": "chronoscene.cli.runs.survey:command",
    "synth": "chronoscene.cli.scenes.synth:command",
    "table": "chronoscene.cli.report.results:table",
    "tradeoff": "chronoscene.cli.report.tradeoff:command",
    "tune": "chronoscene.cli.runs.tune:command",
    "triangulate": "chronoscene.cli.scenes.triangulate:command",
    "undistort": "chronoscene.cli.scenes.undistort:command",
    "validate": "chronoscene.cli.scenes.validate:command",
    "verify": "chronoscene.cli.report.verify:command",
    "view": "chronoscene.cli.runs.view:command",
}
"""Command name to ``module:attribute``."""

SETTINGS = {"help_option_names": ["-h", "--help"], "show_default": True}
"""Settings of all commands."""

INTERRUPTED = 130  # Exit status after Ctrl-C or SIGTERM, as in a shell

USAGE_ERROR = 2  # Exit status for wrong usage and for input that cannot be read at all


class LazyGroup(click.Group):
    """Group that imports the module of a command at its first use."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return sorted(COMMANDS)

    def get_command(self, ctx: click.Context, cmd_name: str) -> click.Command | None:
        if cmd_name not in COMMANDS:
            return None
        module, _, attribute = COMMANDS[cmd_name].partition(":")
        command: click.Command = getattr(importlib.import_module(module), attribute)
        return command


@click.group(
    cls=LazyGroup, context_settings={"help_option_names": ["-h", "--help"], "show_default": True}
)
@click.version_option(__version__, prog_name="chronoscene")
def cli() -> None:
    """Prepare datasets of multi-period scenes and benchmark reconstruction methods on them."""


def main() -> None:
    """Run the command line; print errors of ours in one line, with exit status 2.

    SIGTERM ends a command like an interruption, so that it cleans up.
    """
    try:
        with stoppable():
            status = cli.main(prog_name="chronoscene", standalone_mode=False)
        sys.exit(status if isinstance(status, int) else 0)
    except click.Abort:  # Ctrl-C: 1 would say that something failed
        click.secho("interrupted; what was finished before is kept", err=True)
        sys.exit(INTERRUPTED)
    except click.ClickException as error:
        error.show()
        sys.exit(error.exit_code)
    except ChronoSceneError as error:
        _end(str(error))
    except OSError as error:  # a full disk, a place that went away
        if (full := disk_full(error, error.filename or "output")) is not None:
            _end(str(full))
        place = f"{error.filename}: " if error.filename else ""
        _end(f"{place}{error.strerror or error}; what was finished before is kept")


def _end(message: str) -> None:
    click.secho(f"error: {printable_lines(message)}", fg="red", err=True)
    sys.exit(USAGE_ERROR)
