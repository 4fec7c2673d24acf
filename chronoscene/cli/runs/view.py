"""``chronoscene view``: finished runs, scenes and registrations, live in the browser."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import suppress
from pathlib import Path

import click

from chronoscene.cli.options import DEVICE, PATH, PLUGIN, SCENE, reading_options, refuse_options
from chronoscene.cli.output import say
from chronoscene.cli.scenes.reading import read_and_note
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import RUN_FILE
from chronoscene.harness.use.page import check_runs
from chronoscene.harness.use.trained_run import open_run
from chronoscene.harness.view.content import Content
from chronoscene.harness.view.server import ANYWHERE, PORT, ViewServer, choose_port, tunnel_command
from chronoscene.harness.view.summary import certificate_summary
from chronoscene.kernels.runtime import keep_freed_memory


@click.command("view")
@click.argument("folders", metavar="RUN...|SCENE", nargs=-1, required=True, type=PATH)
@click.option(
    "--port", type=click.IntRange(1, 65535), help=f"Port.  [default: the first free from {PORT} on]"
)
@click.option(
    "--host", default="127.0.0.1", help="Address; 0.0.0.0 lets in all who can reach this machine."
)
@SCENE
@reading_options("the scene, if no run is viewed")
@PLUGIN
@DEVICE
def command(
    folders: tuple[Path, ...],
    port: int | None,
    host: str,
    scene: Path | None,
    dataset_format: str | None,
    period_by: str | None,
    plugin: tuple[str, ...],
    device: str,
) -> None:
    """View runs, a scene or a registration live in the browser.

    RUN is the folder of a run, such as runs/plaza/chronogs-joint-balanced/seed0; two or more runs
    of a scene are compared. SCENE is a dataset, or what register wrote. Ctrl-C ends the viewer.
    """
    keep_freed_memory()  # arrays as large as those of the picture before
    chosen = choose_port(host, port)
    if any((folder / RUN_FILE).is_file() for folder in folders):
        refuse_options(("dataset_format", "period_by"), "with runs")
        runs = [open_run(folder, device=device, plugin=plugin) for folder in folders]
        check_runs(runs)
        say("open the models")
        for run in runs:
            for period in range(run.num_periods):
                run.model(period)
        say("read the scene")
        content = Content(runs[0].scene(scene), runs)
    elif len(folders) > 1:
        raise ConfigError(
            folders[1],
            expected="one scene, or runs only",
            found="several folders without a run",
            todo="view one scene at a time",
        )
    else:
        refuse_options(("scene", "plugin", "device"), "without a run")
        found = read_and_note(folders[0], dataset_format, period_by)
        labels = [period.label for period in found.periods]
        content = Content(found, summary=certificate_summary(folders[0], labels))
    server, status = ViewServer(content, host, chosen), 128 + signal.SIGTERM
    try:
        _report(host, server.port, port or PORT)
        threading.Event().wait()
    except KeyboardInterrupt:
        say("ended")
        status = 0
    finally:
        _stop(server, status)


def _stop(server: ViewServer, status: int) -> None:
    """Stop the server; end the process, too, if it is in the middle of a picture.

    A picture may take minutes. The interpreter would end its thread by unwinding it, which aborts
    where frames of C++ allow no exceptions.
    """
    has_ended = False
    with suppress(KeyboardInterrupt):  # a second one
        has_ended = server.stop()
    if not has_ended:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)


def _report(host: str, port: int, wanted: int) -> None:
    """Print where the viewer is."""
    if port != wanted:
        say(f"port {wanted} is in use")
    name = ANYWHERE.get(host, host)
    place = f"[{name}]" if ":" in name else name
    click.echo(f"http://{place}:{port} is ready for your browser; Ctrl-C ends it")
    if (tunnel := tunnel_command(host, port)) is not None:
        say(f"from another machine, run there first: {tunnel}")
