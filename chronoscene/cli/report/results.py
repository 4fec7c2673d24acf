"""``chronoscene table`` and ``score``: what finished runs say, and scoring them again."""

from __future__ import annotations

from collections.abc import Collection
from functools import partial
from pathlib import Path

import click

from chronoscene.cli.options import EXISTING_FOLDER, LPIPS_WEIGHTS, RUNS, refuse_options, split_list
from chronoscene.cli.output import FORMAT, OUT_FILE, check_place, emit, say, terminal_width
from chronoscene.cli.progress import progress_bar
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import RESULTS_FILE, ROWS_FILE
from chronoscene.harness.report.figures.comparison import draw_figures
from chronoscene.harness.report.figures.sharing import draw_sharing
from chronoscene.harness.report.figures.stage import draw_stages
from chronoscene.harness.report.published import load_published
from chronoscene.harness.report.summary import in_region, read_runs
from chronoscene.harness.report.tables import MAX_PERIODS, format_runs
from chronoscene.harness.score.regions import ALL, REGIONS, freeze_change_masks
from chronoscene.harness.score.scoring import rescore
from chronoscene.metrics.registry import METRICS, make_scorers, metric_info

SOME_FAILED = 1  # Exit status when a run could not be scored


@click.command("score")
@click.argument("runs", type=EXISTING_FOLDER)
@click.option(
    "--metric",
    "metrics",
    multiple=True,
    help="Metrics to compute, as NAME[,NAME...]; the others keep their values. May be repeated.  "
    "[default: all but those on request: "
    f"{', '.join(name for name, info in METRICS.items() if info.on_request)}]",
)
@click.option(
    "--truth",
    type=EXISTING_FOLDER,
    help="Also score changed and invariant regions, by the change masks in this folder. It is laid "
    "out like the gt/ of a generated scene, or contains scenes with a gt/.",
)
@LPIPS_WEIGHTS
def score(
    runs: Path, metrics: tuple[str, ...], truth: Path | None, lpips_weights: Path | None
) -> None:
    """Score finished runs again and print what changed.

    Only the stored predictions and the frozen ground truth are read; their hashes are checked.
    Change masks are frozen with the ground truth, so that later runs in RUNS are also scored with
    them.
    """
    check_place("RUNS", runs)
    with progress_bar("load the metrics") as bar:
        wanted = parse_metrics(metrics)
        if wanted and not any(name.startswith("lpips_") for name in wanted):
            refuse_options(("lpips_weights",), "without LPIPS among --metric")
        scorers = make_scorers(wanted or None, lpips_weights=lpips_weights)
        if truth is not None:
            freeze_change_masks(runs, truth)
        outcomes = rescore(runs, scorers, progress=partial(bar, "runs"))
    for outcome in outcomes:
        name = outcome.folder.relative_to(runs)
        if outcome.error is not None:
            say(f"{name}: error: {outcome.error}", fg="red")
            continue
        emit(f"{name}: {'; '.join(outcome.changes) or 'unchanged'}\n")
        for metric in outcome.kept:
            emit(f"{name}: {metric} kept from an earlier scoring\n")
    for reason in dict.fromkeys(scorers.skipped.values()):
        names = ", ".join(name for name, why in scorers.skipped.items() if why == reason)
        click.echo(f"{names} not computed: {reason}")
    if any(outcome.error is not None for outcome in outcomes):
        click.get_current_context().exit(SOME_FAILED)


def print_runs(out: Path, new: Collection[Path] | None = None) -> None:
    """Print the tables of all runs in a folder, and the files that belong to all of them.

    Args:
        out: Folder of runs.
        new: Folders of runs; figures are drawn of the scenes of these. None for all of them.
    """
    records, failures = read_runs([out])
    text = format_runs(records, failures, "table", width=terminal_width())
    emit(text + "\n")
    places = None if new is None else {path.resolve() for path in new}
    scenes = {r.scene for r in records if places is None or r.folder.resolve() in places}
    drawn = [run for run in records if run.scene in scenes]
    figures = [*draw_figures(out, drawn), *draw_stages(out, drawn), *draw_sharing(out, records)]
    emit("".join(f"{path}\n" for path in (out / RESULTS_FILE, out / ROWS_FILE, *figures)))


@click.command("table")
@RUNS
@FORMAT
@click.option(
    "--metric",
    "metrics",
    multiple=True,
    help="Metrics to show and nothing else, as NAME[,NAME...]. May be repeated.  [default: all]",
)
@click.option(
    "--region",
    type=click.Choice(REGIONS),
    default=ALL,
    help="Part of the images that is scored; see chronoscene score --truth.",
)
@click.option(
    "--published",
    "with_published",
    is_flag=True,
    help="Also show what the paper of ChronoGS printed for scenes of these names.",
)
@click.option(
    "--periods", is_flag=True, help=f"Show every period, even if there are more than {MAX_PERIODS}."
)
@click.option(
    "--columns",
    help="Show only these columns, by their headings, as HEAD[,HEAD...]; units may be left out.",
)
@click.option(
    "--rename",
    "renames",
    metavar="OLD=NEW",
    multiple=True,
    help="Write NEW in place of OLD in the names of methods. May be repeated.",
)
@OUT_FILE
def table(
    folders: tuple[Path, ...],
    style: str,
    columns: str | None,
    renames: tuple[str, ...],
    metrics: tuple[str, ...],
    region: str,
    with_published: bool,
    periods: bool,
    out: Path | None,
) -> None:
    """Print the results of finished runs.

    RUNS are folders of runs. The first table has means over all scenes, as papers print them.
    Further tables have, per scene and metric, each period, macro (mean over periods), micro (mean
    over views) and the worst period, and the costs. Several seeds give the mean, the sample
    standard deviation and the number of runs. Intervals and differences are at 95 % over test
    views.
    """
    if style in ("csv", "json"):  # they have fixed columns, and no titles
        refuse_options(("columns", "renames"), f"with {style}")
    records, failures = read_runs(folders)
    if region != ALL:
        records = in_region(records, region)
    published = load_published() if with_published else None
    width = terminal_width(out)
    text = format_runs(
        records,
        failures,
        style,
        parse_metrics(metrics),
        published=published,
        periods=periods,
        renames=dict(_pair(text) for text in renames),
        columns=() if columns is None else split_list("--columns", columns),
        width=width,
    )
    emit(text, out)


def _pair(text: str) -> tuple[str, str]:
    """Split a value of ``--rename``."""
    old, _, new = text.rpartition("=")  # names have options, such as sh_degree=2
    if not old:
        raise ConfigError(
            "--rename", expected="OLD=NEW", found=repr(text), todo="write the old name first"
        )
    return old, new


def parse_metrics(texts: tuple[str, ...]) -> list[str]:
    """Split comma-separated lists of metrics.

    Raises:
        ConfigError: If there is no such metric.
    """
    return [metric_info(name).name for text in texts for name in split_list("--metric", text)]
