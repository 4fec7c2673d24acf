"""``chronoscene tune``: search for options of a method on views held back from the training."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import FOLDER, SCENES, add_options, look_here_for, reading_options
from chronoscene.cli.output import emit, report_written, say, terminal_width
from chronoscene.cli.runs.bench import MEMORY, settings_from
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.tune.report import PRESET_FILE, TRIALS_FILE, trials_table
from chronoscene.harness.tune.search import tune
from chronoscene.io.tables import boxed_text


@click.command("tune")
@click.argument("method")
@SCENES
@click.option(
    "--trials",
    type=click.IntRange(min=1),
    required=True,
    help="Number of trials in all, failed ones among them.",
)
@click.option(
    "--splits",
    type=click.IntRange(min=1),
    default=1,
    help="Number of choices of validation views: each trial trains each scene as often, and its "
    "score is the mean.",
)
@click.option("--seed", type=click.IntRange(min=0), default=0, help="Seed of search and trainings.")
@click.option(
    "--strategy",
    type=click.Choice([*STRATEGIES]),
    help="Strategy of the trials.  [default: that of the method]",
)
@reading_options("the scenes")
@add_options("preset", "iterations", "jobs", "job_memory", "ray", "threads", "device")
@MEMORY
@click.option("--out", type=FOLDER, required=True, help="Folder for the search.")
def command(
    method: str,
    trials: int,
    splits: int,
    seed: int,
    strategy: str | None,
    out: Path,
    **options: Any,
) -> None:
    """Search for options by scores on validation views.

    Each trial trains METHOD on each scene with other options, as bench --validation does; the first
    trial has those of the preset. The options with the highest mean PSNR are written to preset.toml
    in --out, which bench takes as --preset; trials.csv has all trials. The same command continues
    after an interruption, also with more --trials. docs/guides/tuning.md describes the search.
    """
    look_here_for([method])
    settings = settings_from(
        methods=(method,),
        strategies=(strategy,) if strategy else (),
        seeds=(seed,),
        out=out,
        assignments=(),
        **options,
    )
    results = tune(settings, trials, say, splits=splits)
    emit(boxed_text(trials_table(results), width=terminal_width()))
    report_written(out / PRESET_FILE, out / TRIALS_FILE)
