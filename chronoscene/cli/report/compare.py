"""``chronoscene compare``: what finished runs show, side by side, and one page of all of them."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FOLDER, FILE
from chronoscene.cli.output import (
    A_FILE,
    check_file,
    emit,
    report_written,
    terminal_width,
    writing_to,
)
from chronoscene.harness.report.comparison_figure import draw_figures
from chronoscene.harness.report.comparison_page import comparison_page
from chronoscene.harness.report.single_views import view_scores, worst_views
from chronoscene.harness.report.summary import read_runs
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
def command(
    runs: Path, views: int, metric: str, style: str, out: Path | None, html: Path | None
) -> None:
    """Show where the methods of finished runs differ.

    Figures are written to RUNS/figures: photos and predictions side by side, with the window in
    which methods differ most enlarged, and error maps on one scale. The worst test views of all
    methods are printed.
    """
    check_file("--out", out)
    check_file("--html", html)
    name = metric_info(metric).name
    records, failures = read_runs([runs])
    scores = view_scores(records, name)
    worst = list(worst_views(scores, records, name))
    if style == "csv":
        emit(scores.to_csv(lineterminator="\n"), out)
    else:
        width = terminal_width(out)
        emit("\n".join(boxed_text(table, width=width) for table in worst), out)
    with writing_to("RUNS", runs):
        report_written(*draw_figures(runs, records, views_per_period=views))
    if html is not None:
        text = comparison_page(runs, records, failures, worst)
        with writing_to("--html", html, expected=A_FILE):
            write_text_atomic(html, text)
        report_written(html)
