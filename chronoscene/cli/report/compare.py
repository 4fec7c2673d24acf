"""``chronoscene compare``: what finished runs show, side by side, and one page of all of them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FOLDER, FILE, PLUGIN, SCENE, refuse_options
from chronoscene.cli.output import (
    A_FILE,
    check_file,
    emit,
    report_written,
    say,
    terminal_width,
    writing_to,
)
from chronoscene.cli.progress import progress_bar
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.files.ground_truth import truth_of
from chronoscene.harness.files.records import Failure, RunRecord
from chronoscene.harness.report.comparison_page import comparison_page
from chronoscene.harness.report.figures.between import between_csv, between_table, draw_between
from chronoscene.harness.report.figures.comparison import by_scene, chosen_views, draw_figures
from chronoscene.harness.report.single_views import view_scores, worst_views
from chronoscene.harness.report.summary import read_runs
from chronoscene.harness.use.between import measure_between, parse_dates
from chronoscene.harness.use.trained_run import open_run
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.tables import boxed_text
from chronoscene.metrics.registry import metric_info


@click.command("compare")
@click.argument("runs", type=EXISTING_FOLDER)
@click.option(
    "--views",
    type=click.IntRange(min=1),
    default=1,
    help="Test views of each period in the figures.",
)
@click.option("--metric", default="psnr", help="Metric of the table.")
@click.option(
    "--format",
    "style",
    type=click.Choice(["table", "csv"]),
    default="table",
    help="Format of the table; csv has every view, table the worst only.",
)
@click.option("--out", type=FILE, help="Write the table to this file instead of the terminal.")
@click.option(
    "--html",
    type=FILE,
    help="Also write one page of all runs to this file: tables, quality against time, and sliders "
    "between the photos and what methods show. It needs no other file.",
)
@click.option(
    "--periods",
    metavar="FROM:TO",
    help="Render what methods show between two neighbouring periods instead, and print how far "
    "that is from the nearer one.",
)
@SCENE
@PLUGIN
def command(
    runs: Path,
    views: int,
    metric: str,
    style: str,
    out: Path | None,
    html: Path | None,
    periods: str | None,
    scene: Path | None,
    plugin: tuple[str, ...],
) -> None:
    """Show where the methods of finished runs differ.

    Figures are written to RUNS/figures: photos and predictions side by side, with the window in
    which methods differ most enlarged, and error maps on one scale. The worst test views of all
    methods are printed.

    With --periods, the models are rendered: one test camera from one period to the next, a row for
    each method. docs/reference/scores.md defines the score.
    """
    check_file("--out", out)
    check_file("--html", html)
    if periods is None:
        refuse_options(("scene", "plugin"), "without --periods")
    else:
        refuse_options(("views", "metric", "html"), "with --periods")
        compare_between(runs, periods, style, out, scene, plugin)
        return
    metric = metric_info(metric).name
    records, failures = _finished(runs)
    scores = view_scores(records, metric)
    worst = list(worst_views(scores, records, metric))
    if style == "csv":
        emit(scores.to_csv(lineterminator="\n"), out)
    else:
        width = terminal_width(out)
        emit("\n".join(boxed_text(table, width=width) for table in worst), out)
    for name in sorted({run.scene for run in records} - by_scene(records).keys()):
        say(f"{name}: no pictures, as its runs are not of the frozen photos")
    with writing_to("RUNS", runs):
        report_written(*draw_figures(runs, records, views_per_period=views))
    if html is not None:
        text = comparison_page(runs, records, failures, worst)
        with writing_to("--html", html, expected=A_FILE):
            write_text_atomic(html, text)
        report_written(html)


def _finished(runs: Path) -> tuple[list[RunRecord], list[Failure]]:
    """Read the runs of a folder, of which one at least is finished, and the failures."""
    records, failures = read_runs([runs])
    if not records:
        raise CheckpointError(
            runs,
            expected="a finished run",
            found=f"runs that failed: {failures[0].reason}",
            todo="correct that, and run bench again",
        )
    return records, failures


def compare_between(
    runs: Path,
    periods: str,
    style: str,
    out: Path | None,
    root: Path | None,
    plugin: tuple[str, ...],
) -> None:
    """Render and score the methods of all scenes between two periods; draw a figure of each."""
    records, _ = _finished(runs)
    found = []
    with progress_bar() as bar:
        for name, drawn in by_scene(records).items():
            # Other programs, whose threads are not known, do not render here.
            chosen = [record for record in drawn if record.threads is not None]
            for record in drawn:
                if record.threads is None:
                    say(f"{record.label}: left out, as another program made its images")
            if not chosen:
                continue
            opened = [open_run(record.folder, plugin=plugin) for record in chosen]
            dates = parse_dates(opened[0], periods)
            views = chosen_views(truth_of(chosen[0].folder), 1)
            if not (own := [v.view for v in views if v.camera_period in dates]):
                raise ConfigError(
                    f"--periods {periods}",
                    expected="a period with test views",
                    found="none",
                    todo="name others",
                )
            scene = opened[0].scene(root)
            progress = partial(bar, f"{name}: render")
            found.append(measure_between(opened, scene, dates, own[0], progress=progress))
    if style == "csv":
        emit(between_csv(found), out)
    else:
        width = terminal_width(out)
        emit("\n".join(boxed_text(between_table(part), width=width) for part in found), out)
    with writing_to("RUNS", runs):
        report_written(*(draw_between(runs, part) for part in found))
