"""``chronoscene compare``: what finished runs show, side by side, and one page of all of them."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click
from click.core import ParameterSource

from chronoscene.cli.options import EXISTING_FOLDER, FILE, PLUGIN, SCENE
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
from chronoscene.errors import ConfigError
from chronoscene.harness.files.ground_truth import truth_of
from chronoscene.harness.report.comparison_page import comparison_page
from chronoscene.harness.report.figures.between import between_csv, between_table, draw_between
from chronoscene.harness.report.figures.comparison import by_scene, chosen_views, draw_figures
from chronoscene.harness.report.single_views import view_scores, worst_views
from chronoscene.harness.report.summary import kind_of, read_runs
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
    help="Format of the table; csv has every view, not the worst alone.",
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
    if periods is not None:
        _refuse_options()
        compare_between(runs, periods, style, out, scene, plugin)
        return
    metric = metric_info(metric).name
    records, failures = read_runs([runs])
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


def _refuse_options() -> None:
    """Refuse options that have no effect with --periods."""
    context = click.get_current_context()
    for name in ("views", "metric", "html"):
        if context.get_parameter_source(name) == ParameterSource.COMMANDLINE:
            raise ConfigError(
                f"--{name}", expected="none with --periods", found="one", todo="leave one out"
            )


def compare_between(
    runs: Path,
    periods: str,
    style: str,
    out: Path | None,
    root: Path | None,
    plugin: tuple[str, ...],
) -> None:
    """Render and score the methods of all scenes between two periods; draw a figure of each."""
    records, _ = read_runs([runs])
    found = []
    with progress_bar() as bar:
        for name, chosen in by_scene(records).items():
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
            titles = [f"{record.title}\n{kind_of(record)}" for record in chosen]
            progress = partial(bar, f"{name}: render")
            found.append(measure_between(opened, titles, scene, dates, own[0], progress=progress))
    if style == "csv":
        emit(between_csv(found), out)
    else:
        width = terminal_width(out)
        emit("\n".join(boxed_text(between_table(part), width=width) for part in found), out)
    with writing_to("RUNS", runs):
        report_written(*(draw_between(runs, part) for part in found))
