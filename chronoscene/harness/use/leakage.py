"""Leakage between periods: test cameras rendered at all other periods, against ground truth.

A model that does not separate two periods shows a bit of both, or the one that it learned last. It
is measured where the true picture of the same camera at another period is known.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Mask, Pixels
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.files.records import ViewScore
from chronoscene.harness.score.regions import ALL, CHANGED, INVARIANT
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.images.truth import (
    UNCHANGED,
    check_distinct,
    load_changes,
    load_depth,
    load_other,
    truth_place,
)
from chronoscene.io.tables import Table
from chronoscene.metrics.change import change_scores, share_of_other
from chronoscene.metrics.depth import depth_errors
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame, Scene

Key = tuple[str, str]
"""Region and metric."""

COLUMNS: dict[Key, tuple[str, int]] = {
    (ALL, "psnr"): ("PSNR [dB]", 2),
    (CHANGED, "psnr"): ("PSNR changed [dB]", 2),
    (INVARIANT, "psnr"): ("PSNR invariant [dB]", 2),
    (INVARIANT, "consistency"): ("consistency [dB]", 2),
    (INVARIANT, "consistency_truth"): ("of the truth [dB]", 2),
    (CHANGED, "sensitivity"): ("sensitivity", 3),
    (CHANGED, "ghosting"): ("ghosting", 3),
    (ALL, "change_ap"): ("AP", 3),
    (ALL, "change_ap_geometry"): ("AP geometry", 3),
    (ALL, "change_ap_appearance"): ("AP appearance", 3),
    (ALL, "depth_abs_rel"): ("AbsRel", 4),
    (ALL, "depth_rmse"): ("RMSE [world units]", 3),
    (ALL, "depth_delta"): ("delta < 1.25", 3),
}
"""Heading with unit, and decimals of each measure, in the order of the table."""


def measure_leakage(run: TrainedRun, scene: Scene, truth: Path) -> Iterator[list[ViewScore]]:
    """Yield the measures of one test view after the other, rendered at each period.

    Args:
        run: The run.
        scene: The scene of the run.
        truth: Folder laid out like ``gt/`` of a generated scene; files may be missing.

    Raises:
        ImageError: If a file of the truth is damaged or that of two views, or a change mask has
            another size.
    """
    store = run.photos(scene)
    check_distinct(truth, (frame.name for frame in scene.select(split="test")))
    for frame in scene.select(split="test"):
        camera, mask = store.camera(frame), store.load_mask(frame)
        counted = np.ones(camera.size[::-1], bool) if mask is None else mask
        if counted.any():
            yield _of_view(run, store, frame, truth, counted)


def _of_view(
    run: TrainedRun, store: ImageStore, frame: Frame, truth: Path, counted: Mask
) -> list[ViewScore]:
    camera, own, photo = store.camera(frame), frame.period, store.load(frame)
    rendered = [run.render(camera, frame.cam_from_world, p) for p in range(run.num_periods)]
    images = [to_bytes(prediction.rgb) for prediction in rendered]
    rows = []
    for period, prediction in enumerate(rendered):
        other = None if period == own else period
        true = photo if other is None else load_other(truth, frame.name, other, camera.size)
        values = {} if true is None else {(ALL, "psnr"): psnr(images[period], true, counted)}
        depth = load_depth(truth, frame.name, other)
        if depth is not None and prediction.depth is not None:
            values |= depth_values(prediction.depth, depth, counted)
        path = truth / truth_place("change", frame.name, period)
        if other is not None and path.is_file():
            changes = load_changes(path, camera.size, run.record.max_width)
            values |= pair_values(images[own], images[period], photo, true, changes, counted)
        rows += [ViewScore(frame.name, own, period, *key, value) for key, value in values.items()]
    return rows


def depth_values(
    depth: NDArray[np.floating], truth: NDArray[np.floating], counted: Mask
) -> dict[Key, float]:
    """Return errors of depth, if it is known at the size of the image: it is not resized."""
    if depth.shape != truth.shape or not (truth[counted] > 0).any():
        return {}
    return {(ALL, name): value for name, value in depth_errors(depth, truth, counted).items()}


def pair_values(
    own: Pixels, other: Pixels, photo: Pixels, truth: Pixels | None, changes: Pixels, counted: Mask
) -> dict[Key, float]:
    """Compare the renders of one camera at two periods.

    - ``psnr`` of the other period, where it differs from the own one and where it does not.
    - ``consistency``: PSNR of the two renders against each other where nothing changed, and
      ``consistency_truth``, the same of the two truths, which differ in their light.
    - ``ghosting``: share of the other truth in the render of the own period, where they differ.
    - ``sensitivity``: growth of that share when the other period is rendered.
    - ``change_ap``: average precision of the difference between the renders as a change map.

    Args:
        own: The render at the period of the photo. [H, W, 3]
        other: The render at the other period. [H, W, 3]
        photo: The photo of the camera. [H, W, 3]
        truth: The true picture at the other period; None if it is not known. [H, W, 3]
        changes: Change mask of the two periods. [H, W]
        counted: Pixels that count. [H, W]
    """
    changed, same = counted & (changes != UNCHANGED), counted & (changes == UNCHANGED)
    difference = np.abs(own.astype(int) - other).sum(axis=2)
    found = change_scores(difference, changes, counted)
    values = {(ALL, name): value for name, value in found.items()}
    if same.any():
        values[INVARIANT, "consistency"] = psnr(other, own, same)
    if truth is None:
        return values
    if same.any():
        values[INVARIANT, "psnr"] = psnr(other, truth, same)
        values[INVARIANT, "consistency_truth"] = psnr(truth, photo, same)
    if changed.any():
        values[CHANGED, "psnr"] = psnr(other, truth, changed)
        if (photo[changed] != truth[changed]).any():
            shares = [share_of_other(image, photo, truth, changed) for image in (own, other)]
            values[CHANGED, "ghosting"] = shares[0]
            values[CHANGED, "sensitivity"] = shares[1] - shares[0]
    return values


def leakage_table(rows: Iterable[ViewScore], labels: Mapping[str, str], title: str) -> Table:
    """Return a table with means over the views of each pair of periods, then over the pairs.

    Args:
        rows: Result of `measure_leakage`.
        labels: Labels of the periods by their ids.
        title: Title of the table.
    """
    cells: dict[tuple[int, int], dict[Key, list[float]]] = defaultdict(lambda: defaultdict(list))
    for row in rows:
        pair = row.camera_period, row.rendered_period
        cells[pair][row.region, row.metric].append(row.value)
    pairs = {
        pair: {key: float(np.mean(v)) for key, v in found.items()}
        for pair, found in sorted(cells.items())
    }
    shown = [key for key in COLUMNS if any(key in means for means in pairs.values())]
    lines = [[labels[str(a)], labels[str(b)], *_texts(m, shown)] for (a, b), m in pairs.items()]
    for name, own in (("own", True), ("another", False)):
        chosen = [means for (a, b), means in pairs.items() if (a == b) == own]
        if chosen:
            lines.append(["mean", name, *_texts(_mean(chosen), shown)])
    heads = ["camera of", "rendered", *(COLUMNS[key][0] for key in shown)]
    return Table(heads, lines, labels=2, title=title, breaks={len(pairs) - 1})


def _mean(parts: Sequence[Mapping[Key, float]]) -> dict[Key, float]:
    keys = dict.fromkeys(key for part in parts for key in part)
    return {key: float(np.mean([part[key] for part in parts if key in part])) for key in keys}


def _texts(means: Mapping[Key, float], keys: Sequence[Key]) -> list[str]:
    return [f"{means[key]:.{COLUMNS[key][1]}f}" if key in means else "-" for key in keys]
