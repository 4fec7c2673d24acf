"""``chronoscene study``: run what answers a question about a method, and say the answer."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from chronoscene.cli.options import (
    LPIPS_WEIGHTS,
    RUNS_OUT,
    SCENES,
    look_here_for,
    reading_options,
    training_options,
)
from chronoscene.cli.output import emit, say, terminal_width
from chronoscene.cli.runs.bench import BUDGET, MEMORY, SOME_FAILED, WIDTH, settings_from
from chronoscene.harness.study.plan import find_study, read_study, run_study
from chronoscene.harness.study.tables import study_texts

ENDINGS = {"markdown": "md", "csv": "csv", "json": "json"}


@click.command("study")
@click.argument("name", metavar="NAME|FILE.toml")
@SCENES
@reading_options("the scenes")
@training_options
@BUDGET
@WIDTH
@MEMORY
@LPIPS_WEIGHTS
@RUNS_OUT
def command(name: str, seeds: int, out: Path, **options: Any) -> None:
    """Compare variants of a method in one table.

    NAME is a study that comes with a method, such as components of ChronoGS; FILE.toml is one of
    your own. docs/guides/studies.md describes both. The runs are those of bench, and finished ones
    are kept. --set applies to the rows that do not set the option themselves. The table has
    measured and published values. It is also written to --out as Markdown, CSV and JSON.
    """
    file = find_study(name)
    study = read_study(file)
    look_here_for([study.method, *(row.method for row in study.rows)])
    settings = settings_from(methods=(), seeds=tuple(range(seeds)), out=out, **options)
    outcome, finished = run_study(study, settings, say)
    if outcome.finished:
        texts = study_texts(study, finished, outcome.failures, width=terminal_width())
        emit(texts["table"])
        for style, ending in ENDINGS.items():
            emit(texts[style], out / f"study-{file.stem}.{ending}")
    else:
        for failure in outcome.failures:
            say(f"failed: {failure.scene}, {failure.method}: {failure.reason}")
    if outcome.failures:
        click.get_current_context().exit(SOME_FAILED)
