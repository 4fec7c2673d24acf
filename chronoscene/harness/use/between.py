"""Runs of several methods rendered between two dates."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from chronoscene.arrays import Mask, Pixels
from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.score.between import (
    FRACTIONS,
    BetweenScore,
    MethodBetween,
    SceneBetween,
    color_distance,
    squared_distances,
)
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.images.truth import (
    UNCHANGED,
    check_distinct,
    load_changes,
    load_other,
    truth_place,
)
from chronoscene.scene import Frame, Scene

CHANGE = 0.1
"""Distance of colours, mean over methods, from which a pixel changes where the truth is unknown."""


def parse_dates(run: TrainedRun, text: str) -> tuple[int, int]:
    """Parse ``FROM:TO``, two neighbouring periods of a run by their numbers or labels.

    Raises:
        ConfigError: If it is anything else: at a period in between, a model is to show that one.
    """
    found = run.parse_periods(text)
    if len(found) != 2 or abs(found[1] - found[0]) != 1 or found[0] != int(found[0]):
        raise ConfigError(
            f"--periods {text}",
            expected="two neighbouring periods as FROM:TO, such as 0:1",
            found="periods that are not neighbours" if len(found) == 2 else "one period",
            todo="name two periods with no other between them",
        )
    return int(found[0]), int(found[1])


def measure_between(
    runs: Sequence[TrainedRun],
    scene: Scene,
    dates: tuple[int, int],
    view: str,
    *,
    progress: Callable[[int, int], None],
) -> SceneBetween:
    """Render the test views of two dates at the dates and in between, and score the renders.

    Args:
        runs: Runs of one scene; those without periods in between are rendered at the dates alone.
        scene: Their scene.
        dates: Two neighbouring periods.
        view: Test view whose images are kept, of one of the dates.
        progress: Called with the views that are done and their total.

    Raises:
        ImageError: If a change mask is damaged.
    """
    store = runs[0].photos(scene)
    frames = [frame for frame in scene.select(split="test") if frame.period in dates]
    changes = _true_changes(scene.root / "gt", store, frames, dates, runs[0].record.max_width)
    sums, pixels = np.zeros((len(runs), len(FRACTIONS) + 1)), 0
    shown: list[list[Pixels]] = []
    for number, frame in enumerate(frames):
        progress(number, len(frames))
        wanted = [run.is_continuous or frame.name == view for run in runs]
        images = [
            [_render(run, store, frame, time) for time in times(run, dates)] if render else []
            for run, render in zip(runs, wanted, strict=True)
        ]
        if frame.name == view:
            shown = images
        scored = {i: images[i] for i, run in enumerate(runs) if run.is_continuous}
        mask = changes[number] if changes else _rendered_changes([*scored.values()])
        if (counted := store.load_mask(frame)) is not None:
            mask = mask & counted
        pixels += int(mask.sum())
        for i, of_run in scored.items():
            sums[i] += squared_distances(of_run, mask)
    gap = (None,) * len(FRACTIONS)
    methods = [
        MethodBetween(run.record, tuple(images), BetweenScore.of(sums[i], pixels))
        if run.is_continuous
        else MethodBetween(run.record, (images[0], *gap, images[-1]), None)
        for i, (run, images) in enumerate(zip(runs, shown, strict=True))
    ]
    return SceneBetween(
        scene=scene.name,
        dates=dates,
        labels=runs[0].record.period_labels,
        view=view,
        truths=_truths(scene, store, next(f for f in frames if f.name == view), dates),
        methods=tuple(methods),
        pixels=pixels,
        from_truth=bool(changes),
    )


def times(run: TrainedRun, dates: tuple[int, int]) -> tuple[float, ...]:
    """Return the dates, and the times in between where the run has them."""
    first, last = dates
    middle = [first + f * (last - first) for f in FRACTIONS] if run.is_continuous else []
    return first, *middle, last


def _render(run: TrainedRun, store: ImageStore, frame: Frame, time: float) -> Pixels:
    return to_bytes(run.render(store.camera(frame), frame.cam_from_world, time).rgb)


def _other(frame: Frame, dates: tuple[int, int]) -> int:
    return dates[1] if frame.period == dates[0] else dates[0]


def _true_changes(
    truth: Path, store: ImageStore, frames: Sequence[Frame], dates: tuple[int, int], max_width: int
) -> list[Mask]:
    """Read where views change between the dates; empty if it is not known of all."""
    check_distinct(truth, (frame.name for frame in frames))
    paths = [truth / truth_place("change", frame.name, _other(frame, dates)) for frame in frames]
    if not all(path.is_file() for path in paths):
        return []
    return [
        load_changes(path, store.camera(frame).size, max_width) != UNCHANGED
        for path, frame in zip(paths, frames, strict=True)
    ]


def _rendered_changes(images: Sequence[Sequence[Pixels]]) -> Mask:
    """Find where methods, on average, show a difference; the same pixels for all of them. [H, W]"""
    if not images:
        return np.zeros((1, 1), bool)
    differences = [color_distance(of_run[0], of_run[-1]) for of_run in images]
    return np.mean(differences, axis=0) > CHANGE


def _truths(
    scene: Scene, store: ImageStore, frame: Frame, dates: tuple[int, int]
) -> tuple[Pixels | None, Pixels | None]:
    size = store.camera(frame).size
    other = load_other(scene.root / "gt", frame.name, _other(frame, dates), size)
    photo = store.load(frame)
    return (photo, other) if frame.period == dates[0] else (other, photo)
