"""Scores of entries computed again: from their own predictions, or beside the runs of a folder."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.harness.files.predictions import MANIFEST, read_manifest
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.comparable import KEY
from chronoscene.harness.score.regions import ALL
from chronoscene.harness.score.scoring import Scores, put_scores, score_folder
from chronoscene.harness.score.verification import Verified
from chronoscene.metrics.registry import Scorers
from leaderboard.entries import MAX_BYTES, EntryRun, entry_files, read_entry, refused

TOLERANCE = 1e-3
"""Largest difference of two values of a view, relative to the computed one if that is above 1.
Another version of a library may decode photos differently; the board shows its own values."""


def score_again(
    entry: Path, part: EntryRun, predictions: Path, truth: Path, scorers: Scorers
) -> RunRecord:
    """Score the predictions of a run of an entry, and return its record with these values alone.

    Args:
        entry: File of the entry.
        part: The run.
        predictions: Folder of its predictions.
        truth: The frozen test photos.
        scorers: The metrics to compute.

    Raises:
        ConfigError: If the images or their values are not those of the entry.
        CheckpointError: If the folder is damaged, or is not of all test views.
    """
    if any(place.is_symlink() for place in (predictions, predictions.parent)):
        raise refused(predictions, "a link")
    if (predictions / MANIFEST).is_file() and (predictions / MANIFEST).stat().st_size > MAX_BYTES:
        raise refused(predictions / MANIFEST, f"more than {MAX_BYTES} bytes")
    manifest = read_manifest(predictions)
    images = {(image.view, image.camera_period, image.sha256) for image in manifest.images}
    if images != {(view.view, view.period, view.sha256) for view in part.views}:
        raise refused(predictions, "other images than the entry lists")
    scores = score_folder(predictions, truth, scorers)
    check_values(entry, part, scores)
    record = part.record.model_copy(update={"rows": scores.rows})
    put_scores(record, scores)
    if not record.periods:
        raise CheckpointError(
            predictions,
            expected="a metric that can be computed here",
            found="none",
            todo="install what it needs; chronoscene doctor says what is missing",
        )
    return record


def check_values(entry: Path, part: EntryRun, scores: Scores) -> None:
    """Compare the values of a run with computed ones, where there are any.

    Raises:
        ConfigError: If one differs by more than `TOLERANCE`, or is that of the photo itself; or if
            other views have values.
    """
    given = {view.view for view in part.scored}
    scored = {row.view for row in scores.rows if row.region == ALL}
    if scored and (wrong := sorted(given ^ scored)):
        expected, found = f"no values of {wrong[0]!r}, whose mask ignores every pixel", "some"
        if wrong[0] in scored:
            expected, found = f"values of {wrong[0]!r}, whose photo has pixels that count", "none"
        raise _wrong(entry, part, expected, found)
    stored = {(row.view, row.metric): row.value for row in part.rows}
    for row in scores.rows:
        value = stored.get((row.view, row.metric))
        if row.region != ALL or value is None:
            continue
        if not math.isfinite(row.value):
            expected = f"a prediction of {row.view!r}"
            raise _wrong(entry, part, expected, f"its photo, with {row.metric} {row.value}")
        if abs(value - row.value) > TOLERANCE * max(1.0, abs(row.value)):
            expected = f"{row.metric} {row.value:.6g} for {row.view!r}, as its image has"
            raise _wrong(entry, part, expected, f"{value:.6g}")


def _wrong(entry: Path, part: EntryRun, expected: str, found: str) -> ConfigError:
    """Make the error of a value that is not that of its image."""
    return ConfigError(
        f"{entry}, seed {part.record.seed}",
        expected=expected,
        found=found,
        todo="score the runs again with chronoscene score, and submit them again",
    )


def verify_entries(folder: Path, runs: Iterable[Verified]) -> Iterator[Verified]:
    """Compare each run of all entries with the run of equal `KEY` and seed, if it is there.

    Args:
        folder: Folder of entries. Those that cannot be read are findings, not errors.
        runs: What `chronoscene.harness.score.verification.verify` found.
    """
    keys = (*KEY, "seed")
    there = {
        tuple(getattr(run.record, name) for name in keys): run
        for run in runs
        if run.record is not None and run.images
    }
    for path in entry_files(folder):
        try:
            entry = read_entry(path)
        except ConfigError as error:
            yield Verified(str(path), differs=[str(error)])
            continue
        for part in entry.runs:
            label = f"{path}: seed {part.record.seed}"
            run = there.get(tuple(getattr(part.record, name) for name in keys))
            if run is None:
                yield Verified(
                    label, unchecked={"entry": "no run of it in RUNS (unchecked in the table)"}
                )
            else:
                yield _verified(label, part, run)


def _verified(label: str, part: EntryRun, run: Verified) -> Verified:
    """Compare images and values; metrics that the run has not are left out."""
    assert run.record is not None
    found = Verified(label, len(part.views))
    found.compare("sha256", part.images, run.images)
    given = {name for view in part.views for name in view.values}
    found.metrics = tuple(name for name in run.metrics if name in given)
    reason = "not computed for its run"
    found.unchecked = {name: run.unchecked.get(name, reason) for name in given - {*run.metrics}}
    computed: dict[str, dict[str, float]] = {}
    for row in run.record.rows:
        if row.region == ALL and row.metric in found.metrics:
            computed.setdefault(row.view, {})[row.metric] = row.value
    stored = {
        view.view: {name: value for name, value in view.values.items() if name in found.metrics}
        for view in part.views
        if view.values
    }
    # The means of an entry are those of its views, or it would have been refused.
    found.compare("views", stored, computed)
    return found
