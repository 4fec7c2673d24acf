"""Scoring finished runs again from their predictions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from chronoscene.bench.ground_truth import ground_truth_folder
from chronoscene.bench.results import (
    PREDICTIONS,
    RunRecord,
    read_rows,
    read_run,
    run_folders,
    write_run,
    write_summary,
)
from chronoscene.bench.scoring import Scores, aggregate, changes, score_folder
from chronoscene.errors import CheckpointError, ChronoSceneError
from chronoscene.metrics.scorers import Scorers


@dataclass(frozen=True, slots=True)
class Rescored:
    """What scoring a run again gave."""

    folder: Path
    changes: list[str]
    """Empty if every aggregate is what it was."""
    kept: list[str]
    """Metrics that could not be computed now and keep their earlier values."""
    error: str | None = None
    """Why the run could not be scored; it is left as it was."""


def rescore(
    runs: Path, scorers: Scorers, *, progress: Callable[[int, int], None] | None = None
) -> list[Rescored]:
    """Score every finished run below a folder again and write what changed.

    Args:
        runs: Folder that bench wrote.
        scorers: The metrics.
        progress: Called with the runs done and their total, before each run.

    Raises:
        CheckpointError: If there is no finished run.
    """
    folders = run_folders(runs)
    if not folders:
        raise CheckpointError(
            runs, expected="a folder of runs", found="no finished run in it", todo="run bench first"
        )
    outcomes: list[Rescored] = []
    for folder in folders:
        if progress is not None:
            progress(len(outcomes), len(folders))
        outcomes.append(_rescore_one(runs, folder, scorers))
    write_summary(runs)
    return outcomes


def _rescore_one(runs: Path, folder: Path, scorers: Scorers) -> Rescored:
    try:
        record = read_run(folder)
        truth = ground_truth_folder(runs, record.scene)
        scores = score_folder(folder / PREDICTIONS, truth, scorers)
        kept, scores = keep_earlier(folder, record, scores)
    except ChronoSceneError as error:
        return Rescored(folder, [], [], str(error))
    before = record.aggregates
    record.aggregates, record.periods = aggregate(scores.rows)
    record.skipped = scores.skipped
    write_run(folder, record, scores.rows)
    return Rescored(folder, changes(before, record.aggregates), kept)


def keep_earlier(folder: Path, record: RunRecord, scores: Scores) -> tuple[list[str], Scores]:
    """Keep earlier values of metrics that this machine cannot compute.

    The images are proven to be the same ones by their hashes, so values from a machine that has the
    weights are worth more than none.
    """
    kept = [name for name in scores.skipped if name in record.aggregates.get("macro", {})]
    if not kept:
        return [], scores
    earlier = tuple(row for row in read_rows(folder) if row.metric in kept)
    skipped = {name: reason for name, reason in scores.skipped.items() if name not in kept}
    rows = sorted(scores.rows + earlier, key=lambda row: row.view)
    return kept, Scores(tuple(rows), skipped)
