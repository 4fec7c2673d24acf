"""The ``chronoscene`` command; the module of a subcommand is imported only when it is called."""

from __future__ import annotations

import importlib
import os
import signal
import sys

import click

from chronoscene import __version__
from chronoscene.errors import ChronoSceneError
from chronoscene.io.processes import stoppable
from chronoscene.io.staging import disk_full
from chronoscene.io.wording import printable_lines

SECTIONS = {
    "From photos to products": {
        "all": ("runs.all:command", "Make a scene, a model, a page and products from photos.")
    },
    "Scenes": {
        "register": ("scenes.register:command", "Register photos of several dates in one frame."),
        "mark": ("scenes.mark:command", "Make a page to mark points in photos."),
        "validate": ("scenes.validate:command", "Check scenes and report all problems."),
        "stats": ("scenes.stats:command", "Print the contents of scenes, by period."),
        "synth": ("scenes.synth:command", "Generate a city photographed at several dates."),
        "download": ("scenes.download:command", "Download the scenes of a public dataset."),
        "convert": ("scenes.convert:command", "Convert a scene to another format."),
        "split": ("scenes.split:command", "Choose new test images of a scene."),
        "edit": (
            "scenes.edit:command",
            "Drop images, periods or points; rename periods or images.",
        ),
        "triangulate": (
            "scenes.triangulate:command",
            "Triangulate sparse points at the poses of a scene.",
        ),
        "undistort": ("scenes.undistort:command", "Undistort the images of a scene."),
    },
    "Benchmarks": {
        "bench": ("runs.bench:command", "Train, render and score methods on scenes."),
        "study": ("runs.study:command", "Compare variants of a method in one table."),
        "tune": ("runs.tune:command", "Search for options by scores on validation views."),
        "score": ("report.results:score", "Score finished runs again and print what changed."),
        "score-images": (
            "runs.score_images:command",
            "Score test views that another program rendered.",
        ),
        "verify": (
            "report.verify:command",
            "Compute scores again and compare them with stored ones.",
        ),
    },
    "Results": {
        "table": ("report.results:table", "Print the results of finished runs."),
        "compare": ("report.compare:command", "Show where the methods of finished runs differ."),
        "tradeoff": ("report.tradeoff:command", "Show what quality costs in finished runs."),
        "leakage": ("runs.leakage:command", "Measure what leaks between the periods of a run."),
        "submit": (
            "report.leaderboard:submit_command",
            "Add finished runs to the entries of the leaderboard.",
        ),
        "leaderboard": (
            "report.leaderboard:leaderboard_command",
            "Build the site of the leaderboard.",
        ),
    },
    "Trained models": {
        "view": ("runs.view:command", "View runs, a scene or a registration live in the browser."),
        "page": ("runs.page:command", "Make a page to walk through finished runs of a scene."),
        "render": ("runs.render:command", "Render a finished run from any camera."),
        "changes": (
            "runs.changes:command",
            "Map what changes between the periods of a finished run.",
        ),
        "survey": (
            "runs.survey:command",
            "Make maps, point clouds, elevation differences and volumes.",
        ),
        "export": ("runs.export:command", "Export periods of a finished run as Gaussians."),
        "compress": ("runs.compress:command", "Compress the model of a finished run."),
    },
    "Methods and this machine": {
        "methods": ("methods.methods:command", "List the installed methods, or describe one."),
        "check-method": (
            "methods.check_method:check",
            "Check that a method keeps the rules for methods.",
        ),
        "new-method": ("methods.check_method:new", "Create the package of a new method."),
        "doctor": ("doctor:command", "Report what works on this machine."),
    },
}
"""Sections of the help: command name to ``module:attribute`` in this package, and a summary, which
is the first sentence of the help of the command."""

COMMANDS = {
    name: f"{__name__}.{target}"
    for commands in SECTIONS.values()
    for name, (target, _) in commands.items()
}
"""Command name to ``module:attribute``."""

INTERRUPTED = 130  # Exit status after Ctrl-C, as in a shell

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

    def format_commands(self, ctx: click.Context, formatter: click.HelpFormatter) -> None:
        """List the commands by section, without their modules."""
        for title, commands in SECTIONS.items():
            with formatter.section(title):
                formatter.write_dl([(name, summary) for name, (_, summary) in commands.items()])


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
    _open_streams()
    try:
        with stoppable():
            status = cli.main(prog_name="chronoscene", standalone_mode=False)
        sys.exit(status if isinstance(status, int) else 0)
    except click.Abort:  # Ctrl-C: 1 would say that something failed
        click.secho("interrupted; what was finished before is kept", err=True)
        sys.exit(INTERRUPTED)
    except SystemExit as end:
        if end.code == 128 + signal.SIGTERM:
            click.secho("terminated; what was finished before is kept", err=True)
        raise
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


def _open_streams() -> None:
    """Open standard streams that the caller closed, or the next file would be one of them."""
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            number = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(number, True)
            setattr(sys, name, os.fdopen(number, mode, encoding="utf-8"))


def _end(message: str) -> None:
    click.secho(f"error: {printable_lines(message)}", fg="red", err=True)
    sys.exit(USAGE_ERROR)
