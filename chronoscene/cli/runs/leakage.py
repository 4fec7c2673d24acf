"""``chronoscene leakage``: traces of other periods in the renders of a run."""

from __future__ import annotations

from dataclasses import astuple
from pathlib import Path

import click

from chronoscene.cli.options import DEVICE, EXISTING_FOLDER, PLUGIN, RUN, SCENE
from chronoscene.cli.output import OUT_FILE, check_file, emit, terminal_width
from chronoscene.cli.progress import tracked
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import ROW_COLUMNS
from chronoscene.harness.use.leakage import COLUMNS, leakage_table, measure_leakage
from chronoscene.harness.use.trained_run import open_run
from chronoscene.io import tables


@click.command("leakage")
@RUN
@click.option(
    "--truth",
    type=EXISTING_FOLDER,
    help="Folder laid out like the gt/ of a generated scene.  [default: gt/ of the scene]",
)
@click.option(
    "--format",
    "style",
    type=click.Choice(["table", "csv", "markdown", "latex"]),
    default="table",
    help="Output format; csv has every view.",
)
@OUT_FILE
@SCENE
@PLUGIN
@DEVICE
def command(
    folder: Path,
    truth: Path | None,
    style: str,
    out: Path | None,
    scene: Path | None,
    device: str,
    plugin: tuple[str, ...],
) -> None:
    """Measure what leaks between the periods of a run.

    Each test camera is rendered at every period and compared with ground truth, which generated
    scenes have: quality, missed changes, ghosts of other periods, depth.
    docs/reference/scores.md defines the columns.
    """
    check_file("--out", out)
    run = open_run(folder, device=device, plugin=plugin)
    found = run.scene(scene)
    place = truth or found.root / "gt"
    tests = len(found.select(split="test"))
    views = measure_leakage(run, found, place) if place.is_dir() else ()
    rows = [row for view in tracked(views, "render", total=tests) for row in view]
    there = {(row.region, row.metric) for row in rows if row.camera_period != row.rendered_period}
    if not there:
        raise ConfigError(
            place,
            expected="change masks, or images of test views at other periods",
            found="none of a test view",
            todo="name a folder with --truth; DATASET.md describes it",
        )
    if style == "csv":
        emit(tables.csv_text(ROW_COLUMNS, map(astuple, rows)), out)
        return
    made = leakage_table(rows, run.record.period_labels, run.record.label)
    emit(tables.text_of(made, style, width=terminal_width(out)), out)
    heads = {key: head.partition(" [")[0] for key, (head, _) in COLUMNS.items()}
    if absent := [name for key, name in heads.items() if key not in there]:
        click.echo(f"no truth, or nothing rendered, for: {', '.join(absent)}", err=True)
