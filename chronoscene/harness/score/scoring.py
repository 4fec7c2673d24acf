"""Scores of a run, from its predictions and the frozen ground truth alone."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Set
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from chronoscene.arrays import Mask, Pixels
from chronoscene.errors import CheckpointError, ChronoSceneError, MetricUnavailableError, ShapeError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import ImageEntry, Manifest, load_image, read_manifest
from chronoscene.harness.files.records import (
    PREDICTIONS,
    ROWS_FILE,
    RUN_FILE,
    STAGES,
    UNTRAINED,
    RunRecord,
    Values,
    ViewScore,
    no_runs,
    read_rows,
    read_run,
    read_with_rows,
    run_folders,
    write_run,
    write_summary_of_readable,
)
from chronoscene.harness.files.strategies import period_part
from chronoscene.harness.plan.job import Job
from chronoscene.harness.score.forgetting import transfer
from chronoscene.harness.score.regions import ALL, REGIONS, change_masks_hash, regions_of
from chronoscene.io.wording import shown
from chronoscene.metrics.registry import Scorers, all_metrics, make_scorers

NO_TESTS = "trained on all photos: there are no test views"


@dataclass(frozen=True, slots=True)
class Scores:
    """All values of a run."""

    rows: tuple[ViewScore, ...]
    skipped: dict[str, str]
    """Metric to the reason for its absence."""
    unscored: tuple[str, ...] = ()
    """Views without values, as their masks ignore every pixel."""
    change_masks: str | None = None
    """Fingerprint of the masks of the regions."""


def score_folder(
    predictions: Path,
    ground_truth: Path,
    scorers: Scorers,
    *,
    fitted: str = "",
    stage: bool = False,
) -> Scores:
    """Score every predicted view that shows the period of its photo.

    Args:
        predictions: Predictions of a run, or of one of its stages.
        ground_truth: The frozen photos.
        scorers: The metrics.
        fitted: As `RunRecord.fitted`.
        stage: Accept missing views, and views that show the last known period.

    Raises:
        CheckpointError: If a manifest or an image is damaged, or the two do not belong together.
    """
    predicted, truth = read_manifest(predictions), read_manifest(ground_truth)
    pairs = match_views(predictions, predicted, truth, stage=stage)
    rows: list[ViewScore] = []
    skipped, unscored = dict(scorers.skipped), []
    for entry, target in pairs:
        image, reference = load_image(predictions, entry), load_image(ground_truth, target)
        periods = entry.camera_period, entry.rendered_period
        for region, mask in regions_of(ground_truth, target, fitted):
            if mask is not None and not mask.any():
                if region == ALL:
                    unscored.append(entry.view)
                continue
            values, refused = score_pair(image, reference, scorers, mask)
            if region == ALL:
                skipped |= {name: f"{entry.view}: {reason}" for name, reason in refused.items()}
            rows += [ViewScore(entry.view, *periods, region, *value) for value in values.items()]
    if not pairs:
        skipped = dict.fromkeys([*scorers.functions, *scorers.skipped], NO_TESTS)
    elif len(unscored) == len(pairs):
        skipped |= dict.fromkeys(
            scorers.functions, "the masks of all test views ignore every pixel"
        )
    # A metric that fails on one view has no mean over the test set.
    kept = tuple(row for row in rows if row.metric not in skipped)
    return Scores(kept, skipped, tuple(unscored), change_masks_hash(truth))


def put_scores(record: RunRecord, scores: Scores) -> None:
    """Put the means of scores into the record of their run."""
    record.aggregates, record.periods = aggregate(scores.rows)
    record.skipped, record.change_masks = scores.skipped, scores.change_masks
    parts = {region: aggregate(scores.rows, region) for region in REGIONS if region != ALL}
    record.regions = {
        region: {"aggregates": aggregates, "periods": periods}
        for region, (aggregates, periods) in parts.items()
        if periods
    }


def score_run(staging: Path, record: RunRecord, truth: Path, scorers: Scorers) -> None:
    """Score the predictions in the folder of a run, and write its record."""
    scores = score_folder(staging / PREDICTIONS, truth, scorers, fitted=record.fitted)
    put_scores(record, scores)
    score_stages(staging, record, truth, scorers)
    if scores.unscored:
        views = shown(scores.unscored)
        record.notices.append(
            f"{record.label}: not scored, as their masks ignore every pixel: {views}"
        )
    write_run(staging, record, scores.rows)


def score_stages(folder: Path, record: RunRecord, truth: Path, scorers: Scorers) -> None:
    """Score the stages of a run, if it has any; earlier values of other metrics are kept.

    The record has the scores of the last stage already.
    """
    stages: dict[str, dict[str, Values]] = {}
    *names, last = UNTRAINED, *map(period_part, range(len(record.period_labels)))
    for name in names if (folder / STAGES).is_dir() else ():
        predictions = folder / STAGES / name
        scores = score_folder(predictions, truth, scorers, fitted=record.fitted, stage=True)
        _, stages[name] = aggregate(scores.rows)
        for period, earlier in record.stages.get(name, {}).items():
            stages[name][period] = earlier | stages[name].get(period, {})
    if stages:
        stages[last] = record.periods
        record.stages, record.transfer = stages, transfer(stages)


def score_job(job: Job, record: RunRecord) -> None:
    """Score the run of a job with all metrics that are available."""
    scorers = make_scorers(lpips_weights=job.settings.lpips_weights)
    truth = ground_truth_folder(job.settings.runs, job.scene)
    score_run(Path(job.staging), record, truth, scorers)


def score_pair(
    image: Pixels, reference: Pixels, scorers: Scorers, mask: Mask | None = None
) -> tuple[Values, dict[str, str]]:
    """Compute the values of one view, and reasons why it has no others.

    Args:
        image: The prediction. [H, W, 3]
        reference: The photo. [H, W, 3]
        scorers: The metrics.
        mask: Pixels that count. The other pixels are taken from the photo, so that windows that
            reach there see no difference. [H, W]
    """
    values, refused = {}, {}
    if mask is not None:
        image = np.where(mask[..., None], image, reference)
    for name, function in scorers.functions.items():
        try:
            value = function(image, reference, mask)
        except ShapeError as error:
            refused[name] = str(error)
            continue
        if math.isnan(value):  # of a metric of another package: no record can hold it
            refused[name] = "its value is not a number"
        else:
            values[name] = value
    return values, refused


def match_views(
    folder: Path, predicted: Manifest, truth: Manifest, *, stage: bool = False
) -> list[tuple[ImageEntry, ImageEntry]]:
    """Pair every test view, or those of a stage, with its prediction.

    Raises:
        CheckpointError: If the scene, a view, its size or its period differs.
    """
    if predicted.scene_hash != truth.scene_hash:
        raise _mismatch(folder, f"scene {truth.scene_hash[:12]}", predicted.scene_hash[:12])
    by_view = {e.view: e for e in (predicted.images if stage else predicted.own_images)}
    targets = {e.view: e for e in truth.images if not stage or e.view in by_view}
    if missing := sorted(targets.keys() ^ by_view.keys()):
        raise _mismatch(folder, "one prediction per test view", f"a difference at {missing[0]!r}")
    for view, target in targets.items():
        mine = by_view[view]
        if (mine.width, mine.height) != (target.width, target.height):
            size = f"{target.width} x {target.height} pixels for {view!r}"
            raise _mismatch(folder, size, f"{mine.width} x {mine.height}")
        if mine.camera_period != target.camera_period:
            period = f"period {target.camera_period} for the camera of {view!r}"
            raise _mismatch(folder, period, f"period {mine.camera_period}")
    return [(by_view[view], target) for view, target in targets.items()]


def _mismatch(folder: Path, expected: str, found: str) -> CheckpointError:
    return CheckpointError(
        folder, expected=expected, found=found, todo="delete the run and run bench again"
    )


def aggregate(
    rows: Iterable[ViewScore], region: str = ALL
) -> tuple[dict[str, Values], dict[str, Values]]:
    """Compute the means of the rows of a region.

    Returns:
        aggregates: ``macro`` (mean over periods of their means), ``micro`` (mean over views) and
            ``worst`` (mean of the worst period), each metric to value.
        periods: Period id as text to metric to mean over its views.
    """
    groups: dict[str, dict[int, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        if row.region == region:
            groups[row.metric][row.camera_period].append(row.value)
    aggregates: dict[str, Values] = {"macro": {}, "micro": {}, "worst": {}}
    periods: dict[str, Values] = {}
    for metric, by_period in groups.items():
        means = {period: float(np.mean(by_period[period])) for period in sorted(by_period)}
        worst = min if all_metrics()[metric].higher_is_better else max
        aggregates["macro"][metric] = float(np.mean(list(means.values())))
        aggregates["micro"][metric] = float(np.mean([v for p in by_period.values() for v in p]))
        aggregates["worst"][metric] = worst(means.values())
        for period, mean in means.items():
            periods.setdefault(str(period), {})[metric] = mean
    return aggregates, dict(sorted(periods.items(), key=lambda item: int(item[0])))


def metrics_of(record: RunRecord) -> set[str]:
    """Return the names of the metrics that a run was scored by."""
    return {row.metric for row in record.rows} | record.aggregates.get("macro", {}).keys()


def check_installed(folder: Path, names: Set[str]) -> None:
    """Check that the metrics of the run in a folder are known here.

    Raises:
        MetricUnavailableError: If one is not, as the package that has it is not installed.
    """
    if unknown := sorted(names - all_metrics().keys()):
        raise MetricUnavailableError(
            folder / ROWS_FILE,
            expected="metrics that are installed",
            found=shown(unknown),
            todo="install the package that has them",
        )


def read_scored(folder: Path) -> RunRecord:
    """Read a finished run with the values of its views, and compare its means with these.

    Raises:
        CheckpointError: If a file is missing or damaged, or a mean is not that of the views.
        MetricUnavailableError: If a metric is not installed.
    """
    run = read_with_rows(folder)
    check_installed(folder, metrics_of(run))
    for region in (ALL, *run.regions):
        parts = run.regions.get(region, {"aggregates": run.aggregates, "periods": run.periods})
        stored = {name: values for part in parts.values() for name, values in part.items()}
        aggregates, periods = aggregate(run.rows, region)
        for place, found, mean in _pairs(stored, aggregates | periods):
            if not math.isclose(found, mean, rel_tol=1e-6, abs_tol=1e-6):
                raise CheckpointError(
                    folder / RUN_FILE,
                    expected=f"{_text(mean)} as {place}: the mean of {ROWS_FILE}",
                    found=_text(found),
                    todo="compute both again with chronoscene score RUNS",
                )
    return run


def _pairs(
    stored: Mapping[str, Values], computed: Mapping[str, Values]
) -> Iterator[tuple[str, float, float]]:
    """Yield the place of each mean that either has, and both values; NaN where there is none."""
    for name in dict.fromkeys((*computed, *stored)):
        one, other = stored.get(name, {}), computed.get(name, {})
        for metric in dict.fromkeys((*other, *one)):
            yield f"{metric}, {name}", one.get(metric, math.nan), other.get(metric, math.nan)


def _text(mean: float) -> str:
    return "nothing" if math.isnan(mean) else f"{mean:.6g}"


def changes(before: Mapping[str, Values], after: Mapping[str, Values]) -> list[str]:
    """Describe differences between two sets of aggregates, one line per metric."""
    old, new = before.get("macro", {}), after.get("macro", {})
    lines = []
    for name in dict.fromkeys([*old, *new]):
        if name not in old:
            lines.append(f"{name} new: {new[name]:.6g}")
        elif name not in new:
            lines.append(f"{name} dropped, was {old[name]:.6g}")
        elif any(before[kind][name] != after[kind][name] for kind in after):
            lines.append(f"{name} {old[name]:.6g} -> {new[name]:.6g} (macro)")
    return lines


@dataclass(frozen=True, slots=True)
class Rescored:
    """Result of scoring a run again."""

    folder: Path
    changes: list[str]
    """Empty if every aggregate is what it was."""
    kept: list[str]
    """Metrics that could not be computed now and keep their earlier values."""
    error: str | None = None
    """Reason why the run could not be scored; it is left as it was."""


def rescore(
    runs: Path, scorers: Scorers, *, progress: Callable[[int, int], None] | None = None
) -> list[Rescored]:
    """Score every finished run below a folder again.

    Runs whose record is damaged, or whose rows are gone, are not in the summary that is written.

    Args:
        runs: Folder that bench wrote.
        scorers: The metrics.
        progress: Called with the runs done and their total, before each run.

    Raises:
        CheckpointError: If there is no finished run.
    """
    folders = run_folders(runs)
    if not folders:
        raise no_runs(runs, "no finished run in it")
    outcomes: list[Rescored] = []
    for folder in folders:
        if progress is not None:
            progress(len(outcomes), len(folders))
        try:
            record = read_run(folder)
        except CheckpointError as error:
            outcomes.append(Rescored(folder, [], [], str(error)))
            continue
        outcomes.append(_rescore_one(runs, folder, record, scorers))
    write_summary_of_readable(runs)
    return outcomes


def _rescore_one(runs: Path, folder: Path, record: RunRecord, scorers: Scorers) -> Rescored:
    try:
        check_installed(folder, metrics_of(record))  # or their values would be lost
        before, parts = record.aggregates, record.regions
        truth = ground_truth_folder(runs, record.scene)
        scores = score_folder(folder / PREDICTIONS, truth, scorers, fitted=record.fitted)
        kept, scores = keep_earlier(folder, record, scores, scorers.unasked)
        put_scores(record, scores)
        score_stages(folder, record, truth, scorers)
    except ChronoSceneError as error:
        return Rescored(folder, [], [], str(error))
    write_run(folder, record, scores.rows)
    lines = changes(before, record.aggregates)
    for region, part in record.regions.items():
        old = parts.get(region, {}).get("aggregates", {})
        lines += [f"{region}: {line}" for line in changes(old, part["aggregates"])]
    return Rescored(folder, lines, kept)


def keep_earlier(
    folder: Path, record: RunRecord, scores: Scores, unasked: Set[str]
) -> tuple[list[str], Scores]:
    """Keep earlier values of metrics that are not available here, or were not asked for.

    Reasons for the absence of metrics that were not asked for are kept, too.

    They hold, as hashes prove that the images are the same; values of regions hold if the change
    masks are the same.

    Returns:
        Names of the kept metrics that cannot be computed, and all scores.
    """
    there = record.aggregates.get("macro", {})
    kept = [name for name in scores.skipped if name in there]
    known = {name: reason for name, reason in record.skipped.items() if name in unasked}
    skipped = known | {name: why for name, why in scores.skipped.items() if name not in kept}
    if not kept and unasked.isdisjoint(there):
        return [], replace(scores, skipped=skipped)
    holds = record.change_masks == scores.change_masks
    earlier = tuple(
        row
        for row in read_rows(folder)
        if (row.metric in kept or row.metric in unasked) and (holds or row.region == ALL)
    )
    rows = sorted(scores.rows + earlier, key=lambda row: row.view)
    return kept, replace(scores, rows=tuple(rows), skipped=skipped)
