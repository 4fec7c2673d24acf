"""``chronoscene score-images``: images of another program as a run like those of bench."""

from __future__ import annotations

from pathlib import Path

import click

from chronoscene.cli.options import (
    EXISTING_FILE,
    EXISTING_FOLDER,
    LPIPS_WEIGHTS,
    PATH,
    RUNS_OUT,
    reading_options,
)
from chronoscene.cli.output import check_place
from chronoscene.cli.progress import progress_bar
from chronoscene.cli.report.results import print_runs
from chronoscene.formats import read_scene
from chronoscene.harness.files.records import write_summary
from chronoscene.harness.score.images import score_images
from chronoscene.images.store import MAX_WIDTH
from chronoscene.metrics.registry import make_scorers


@click.command("score-images")
@click.argument("scene", type=PATH)
@click.argument("folder", type=EXISTING_FOLDER)
@click.option("--name", required=True, help="Name of the program, as tables show it.")
@click.option(
    "--map",
    "table",
    type=EXISTING_FILE,
    help="CSV file with the columns file and view, where files are not named like the views.",
)
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    help="Seed of the training; tables show mean and spread over several.",
)
@reading_options("the scene")
@click.option(
    "--max-width",
    type=click.IntRange(min=1),
    default=MAX_WIDTH,
    help="Scale wider images down to this width in pixels, as bench does.",
)
@LPIPS_WEIGHTS
@RUNS_OUT
def command(
    scene: Path,
    folder: Path,
    name: str,
    table: Path | None,
    seed: int,
    dataset_format: str | None,
    period_by: str | None,
    max_width: int,
    lpips_weights: Path | None,
    out: Path,
) -> None:
    """Score test views that another program rendered.

    FOLDER has a PNG file for each test view of SCENE: b/0007.png or b/0007.jpg.png for b/0007.jpg.
    Images have the size of the evaluation or of the photos. The result is a run like those of
    bench; see docs/guides/other-programs.md.
    """
    check_place("--out", out, outside=[scene])
    with progress_bar(f"read {scene}") as bar:
        whole = read_scene(scene, format=dataset_format, period_by=period_by)
        bar("load the metrics", 0, 1)
        scorers = make_scorers(lpips_weights=lpips_weights)
        bar("score the images", 0, 1)
        score_images(whole, folder, name, out, scorers, table=table, seed=seed, max_width=max_width)
    write_summary(out)
    print_runs(out)
