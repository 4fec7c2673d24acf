"""What leaks between periods: test cameras of one period rendered at all others, against the truth.

A model that cannot tell two periods apart shows a bit of both, or what it learned last. How much of
that is in a picture is seen where the same camera is known at another period.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.bench.opening import OpenRun
from chronoscene.bench.predictions import to_bytes
from chronoscene.bench.regions import ALL, CHANGED, INVARIANT
from chronoscene.bench.results import Row
from chronoscene.images.decoding import load_rgb
from chronoscene.images.store import ImageStore
from chronoscene.images.truth import UNCHANGED, Kind, load_changes, truth_place
from chronoscene.io.tables import Table
from chronoscene.metrics.change import change_scores, share_of_other
from chronoscene.metrics.depth import depth_errors
from chronoscene.metrics.psnr_ssim import psnr
from chronoscene.scene import Frame, Scene

Image = NDArray[np.uint8]
Mask = NDArray[np.bool_]
Key = tuple[str, str]
"""Region and metric."""

COLUMNS: dict[Key, tuple[str, int]] = {
    (ALL, "psnr"): ("PSNR", 2),
    (CHANGED, "psnr"): ("PSNR changed", 2),
    (INVARIANT, "psnr"): ("PSNR invariant", 2),
    (INVARIANT, "consistency"): ("consistency", 2),
    (INVARIANT, "consistency_truth"): ("of the truth", 2),
    (CHANGED, "sensitivity"): ("sensitivity", 3),
    (CHANGED, "ghosting"): ("ghosting", 3),
    (ALL, "change_ap"): ("AP", 3),
    (ALL, "change_ap_geometry"): ("AP geometry", 3),
    (ALL, "change_ap_appearance"): ("AP appearance", 3),
    (ALL, "depth_abs_rel"): ("AbsRel", 4),
    (ALL, "depth_rmse"): ("RMSE", 3),
    (ALL, "depth_delta"): ("delta < 1.25", 3),
}
"""Heading and decimals of what is measured, in the order of the table."""


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
    """A test camera at one period, as it was rendered or as it is in truth."""

    image: Image | None
    """[H, W, 3]"""
    depth: NDArray[np.floating] | None
    """In units of the world. [H, W]"""


def measure_leakage(run: OpenRun, scene: Scene, truth: Path) -> Iterator[list[Row]]:
    """What one test view after the other shows at each period.

    Args:
        run: Renders them.
        scene: Of the run.
        truth: Folder laid out like ``gt/`` of a generated scene; files may be missing.

    Raises:
        ImageError: If a file of the truth is damaged, or a change mask of another size.
    """
    store = ImageStore(scene, max_width=run.record.max_width)
    for frame in scene.select(split="test"):
        camera, mask = store.camera(frame), store.load_mask(frame)
        counted = np.ones(camera.size[::-1], bool) if mask is None else mask
        if counted.any():
            yield _of_view(run, store, frame, truth, counted)


def _of_view(
    run: OpenRun, store: ImageStore, frame: Frame, truth: Path, counted: Mask
) -> list[Row]:
    camera, own = store.camera(frame), frame.period
    rendered, true = {}, {}
    for period in range(run.num_periods):
        prediction = run.render(camera, frame.cam_from_world, period)
        rendered[period] = Shown(to_bytes(prediction.rgb), prediction.depth)
        other = None if period == own else period
        image = store.load(frame) if other is None else None
        if (path := truth / truth_place("cross_rgb", frame.name, other)).is_file():
            image = load_rgb(path, size=camera.size)
        kind: Kind = "depth" if other is None else "cross_depth"
        true[period] = Shown(image, _load_depth(truth / truth_place(kind, frame.name, other)))
    rows = []
    for period in rendered:
        values = quality(rendered[period], true[period], counted)
        path = truth / truth_place("change", frame.name, period)
        if period != own and path.is_file():
            changes = load_changes(path, camera.size, run.record.max_width)
            pair = rendered[own], rendered[period], true[own], true[period]
            values |= pair_values(*pair, changes, counted)
        rows += [Row(frame.name, own, period, *key, value) for key, value in values.items()]
    return rows


def _load_depth(path: Path) -> NDArray[np.floating] | None:
    if not path.is_file():
        return None
    with np.load(path) as arrays:  # refuses pickles
        return np.asarray(arrays["depth"])


def quality(shown: Shown, truth: Shown, counted: Mask) -> dict[Key, float]:
    """How good one picture is, as far as the truth is known. Depth is not resized."""
    values = {}
    if shown.image is not None and truth.image is not None:
        values[ALL, "psnr"] = psnr(shown.image, truth.image, counted)
    d, t = shown.depth, truth.depth
    if d is not None and t is not None and d.shape == t.shape and (t[counted] > 0).any():
        errors = depth_errors(d, t, counted)
        values |= {(ALL, name): value for name, value in errors.items()}
    return values


def pair_values(
    own: Shown, other: Shown, own_truth: Shown, other_truth: Shown, changes: Image, counted: Mask
) -> dict[Key, float]:
    """What two periods of one camera say about each other.

    - ``psnr`` of the other period, where it differs from the own one and where it does not.
    - ``consistency``: PSNR of the two renders against each other where nothing changed, and
      ``consistency_truth``, the same of the two truths, which differ in their light.
    - ``ghosting``: share of the other truth in the render of the own period, where they differ.
    - ``sensitivity``: what that share grows by when the other period is rendered.
    - ``change_ap``: average precision of the difference between the renders as a change map.

    Args:
        own: The render at the period of the photo.
        other: The render at the other period.
        own_truth: The photo.
        other_truth: What the camera would see at the other period.
        changes: Change mask of the two periods. [H, W]
        counted: Pixels that count. [H, W]
    """
    assert own.image is not None and other.image is not None
    changed, same = counted & (changes != UNCHANGED), counted & (changes == UNCHANGED)
    difference = np.abs(own.image.astype(int) - other.image).sum(axis=2)
    found = change_scores(difference, changes, counted)
    values = {(ALL, name): value for name, value in found.items()}
    if same.any():
        values[INVARIANT, "consistency"] = psnr(other.image, own.image, same)
    a, b = own_truth.image, other_truth.image
    if a is None or b is None:
        return values
    if same.any():
        values[INVARIANT, "psnr"] = psnr(other.image, b, same)
        values[INVARIANT, "consistency_truth"] = psnr(b, a, same)
    if changed.any():
        values[CHANGED, "psnr"] = psnr(other.image, b, changed)
        if (a[changed] != b[changed]).any():
            ghosting = share_of_other(own.image, a, b, changed)
            values[CHANGED, "ghosting"] = ghosting
            values[CHANGED, "sensitivity"] = share_of_other(other.image, a, b, changed) - ghosting
    return values


def leakage_table(rows: Iterable[Row], labels: Mapping[str, str], title: str) -> Table:
    """A row for each pair of periods, mean over its views; then means over the pairs.

    Args:
        rows: From `measure_leakage`.
        labels: Of the periods, by their ids.
        title: Of the table.
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
    heads = [(name, "") for name in ("camera of", "rendered", *(COLUMNS[key][0] for key in shown))]
    return Table(heads, lines, labels=2, title=title, breaks={len(pairs) - 1})


def _mean(parts: Sequence[Mapping[Key, float]]) -> dict[Key, float]:
    keys = dict.fromkeys(key for part in parts for key in part)
    return {key: float(np.mean([part[key] for part in parts if key in part])) for key in keys}


def _texts(means: Mapping[Key, float], keys: Sequence[Key]) -> list[str]:
    return [f"{means[key]:.{COLUMNS[key][1]}f}" if key in means else "-" for key in keys]
