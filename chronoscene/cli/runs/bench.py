"""``chronoscene bench``: train methods on scenes, render the test views, score them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
from click.core import ParameterSource

from chronoscene.cli.options import (
    LPIPS_WEIGHTS,
    RUNS_OUT,
    SCENES,
    FiniteRange,
    look_here_for,
    parse_assignments,
    reading_options,
    split_list,
    training_options,
)
from chronoscene.cli.output import check_place, say
from chronoscene.cli.report.results import print_runs
from chronoscene.formats import nearby_scenes
from chronoscene.harness.files.protocols import PROTOCOLS
from chronoscene.harness.files.records import read_failures
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.settings import (
    PHOTO_DISK,
    PHOTO_MEMORY,
    SHARING,
    BenchSettings,
    bench_settings,
)
from chronoscene.harness.plan.stop import parse_duration
from chronoscene.harness.run.runner import BenchOutcome, run_bench
from chronoscene.images.store import MAX_WIDTH

SOME_FAILED = 1  # Exit status when a run failed; the others have their results
BUDGET = click.option(
    "--budget",
    help="Stop after this time on the training clock, such as 90s, 5m or 1h30m. Schedules follow "
    "the clock then, and equal seeds do not give equal models.",
)
WIDTH = click.option(
    "--max-width",
    type=click.IntRange(min=1),
    default=MAX_WIDTH,
    help="Scale wider images down to this width in pixels, for training and evaluation.",
)
MEMORY = click.option(
    "--photo-memory",
    type=FiniteRange(min=0),
    default=PHOTO_MEMORY / 1e9,
    help="Memory for training photos in GB, including their decoding.",
)


@click.command("bench")
@SCENES
@click.option(
    "--method", "methods", required=True, help="Methods to run, as NAME[,NAME...] or module:SPEC."
)
@click.option(
    "--strategy",
    "strategies",
    help=f"One or several of {', '.join(STRATEGIES)}, separated by commas.  [default: that of the "
    "method: sequential for continual learning, else joint]",
)
@click.option(
    "--protocol",
    type=click.Choice([*PROTOCOLS]),
    help="Run as published for the data of another paper: format, periods, test images, sizes and "
    "the order of the periods are fixed.",
)
@reading_options("the scenes")
@training_options
@click.option(
    "--seed",
    type=click.IntRange(min=0),
    default=0,
    help="First seed. Equal seeds give equal models on one machine's CPU, but not with --budget.",
)
@BUDGET
@click.option(
    "--continue-to",
    type=click.IntRange(min=1),
    help="Train finished runs that kept their training further, up to this many iterations.",
)
@click.option(
    "--checkpoint-every",
    default="5m",
    help="Time between checkpoints, from which a run that was stopped continues.",
)
@click.option(
    "--keep-training",
    is_flag=True,
    help="Keep the last checkpoint of finished runs, for --continue-to.",
)
@click.option(
    "--separate-iterations",
    type=click.Choice(SHARING),
    help="Whether the models of strategy separate, or the stages of strategy sequential, share "
    "iterations and budget or each get them.  [default: total; each for presets whose iterations "
    "are per period]",
)
@WIDTH
@MEMORY
@click.option(
    "--photo-disk",
    type=FiniteRange(min=0),
    default=PHOTO_DISK / 1e9,
    help="Disk space below --out in GB for decoded photos, if they do not fit into memory.",
)
@click.option(
    "--validation",
    is_flag=True,
    help="Hold blocks of the training views back and score these; test views are not read. "
    "For choosing options.",
)
@click.option(
    "--validation-seed",
    type=click.IntRange(min=0),
    default=0,
    help="Seed of the choice of these blocks: others for a score on other views.",
)
@click.option(
    "--fit-half",
    is_flag=True,
    help="Fit the appearance of each test view to the left half of its photo, as the paper of "
    "NeRF-W does, and score the right half.",
)
@LPIPS_WEIGHTS
@RUNS_OUT
@click.option(
    "--overwrite",
    is_flag=True,
    help="Replace finished runs, and discard unfinished trainings, that have other settings.",
)
@click.pass_context
def command(
    context: click.Context,
    *,
    methods: str,
    seeds: int,
    seed: int,
    out: Path,
    protocol: str | None,
    **options: Any,
) -> None:
    """Train, render and score methods on scenes.

    DIR is a scene or a folder of scenes; without one, the current folder is searched, then data/.
    Each run (one method, strategy, scene and seed) gets a folder below --out with its checkpoint,
    predictions and scores. Finished runs are kept, so the same command resumes after an
    interruption. docs/guides/benchmark.md describes strategies, budget and seeds.
    """
    names = split_list("--method", methods)
    look_here_for(names)
    if protocol:
        fixed = PROTOCOLS[protocol].options().items()
        source = context.get_parameter_source
        options |= {k: v for k, v in fixed if source(k) is ParameterSource.DEFAULT}
    asked = options["strategies"]
    options["strategies"] = () if asked is None else split_list("--strategy", asked)
    settings = settings_from(
        methods=names,
        seeds=tuple(range(seed, seed + seeds)),
        out=out,
        protocol=protocol or "",
        **options,
    )
    report(run_bench(settings, say), out)


def settings_from(
    *,
    scenes: tuple[Path, ...],
    methods: tuple[str, ...],
    out: Path,
    assignments: tuple[str, ...],
    budget: str | None = None,
    checkpoint_every: str = "5m",
    photo_memory: float = PHOTO_MEMORY / 1e9,
    photo_disk: float = PHOTO_DISK / 1e9,
    **options: Any,
) -> BenchSettings:
    """Make settings from the options of ``bench`` or ``study``, in the units of the terminal.

    Raises:
        ConfigError: If one of them is wrong.
        SceneError: If a folder has no scene.
    """
    reading = {"format": options["dataset_format"], "period_by": options["period_by"]}
    settings = bench_settings(
        scenes or (nearby_scenes(**reading),),
        methods,
        out,
        overrides=parse_assignments(assignments),
        budget_seconds=None if budget is None else parse_duration(budget),
        checkpoint_seconds=parse_duration(checkpoint_every, "--checkpoint-every"),
        photo_memory=round(photo_memory * 1e9),
        photo_disk=round(photo_disk * 1e9),
        **options,
    )
    check_place("--out", out)
    return settings


def report(outcome: BenchOutcome, out: Path) -> None:
    """Print what is in the folder of runs, and why runs failed."""
    if outcome.finished:
        print_runs(out, outcome.finished)
    else:
        for failure in read_failures(out):
            say(f"failed: {failure.scene}, {failure.method}: {failure.reason}")
    if outcome.failures:
        click.get_current_context().exit(SOME_FAILED)
