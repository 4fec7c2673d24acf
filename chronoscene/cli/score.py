"""``chronoscene score``: score finished runs again, without training."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import click

from chronoscene.bench.scoring import rescore
from chronoscene.cli.progress import progress_bar
from chronoscene.metrics.scorers import make_scorers

SOME_FAILED = 1
"""Exit status when a run could not be scored."""


@click.command("score")
@click.argument("runs", type=click.Path(path_type=Path, exists=True, file_okay=False))
@click.option(
    "--lpips-weights",
    type=click.Path(path_type=Path, exists=True),
    help="Folder or file with the weights of LPIPS.",
)
def command(runs: Path, lpips_weights: Path | None) -> None:
    """Score the predictions of all finished runs in RUNS again and say what changed.

    Only the images of each run and the frozen ground truth are read; their hashes are checked.
    """
    scorers = make_scorers(lpips_weights=lpips_weights)
    with progress_bar() as bar:
        outcomes = rescore(runs, scorers, progress=partial(bar, "runs"))
    for outcome in outcomes:
        name = outcome.folder.relative_to(runs)
        if outcome.error is not None:
            click.secho(f"{name}: error: {outcome.error}", fg="red", err=True)
            continue
        click.echo(f"{name}: {'; '.join(outcome.changes) or 'unchanged'}")
        for metric in outcome.kept:
            click.echo(f"{name}: {metric} kept from an earlier scoring")
    for metric, reason in scorers.skipped.items():
        click.echo(f"{metric} not computed: {reason}")
    if any(outcome.error is not None for outcome in outcomes):
        click.get_current_context().exit(SOME_FAILED)
