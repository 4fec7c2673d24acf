"""Change maps of a finished run, their scores against ground truth, and tables of both."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import cv2
import numpy as np

from chronoscene.arrays import Array, Pixels
from chronoscene.errors import ConfigError
from chronoscene.harness.files.predictions import to_bytes
from chronoscene.harness.use.cameras import Viewpoint
from chronoscene.harness.use.changes import (
    APPEARANCE,
    CLASSES,
    GEOMETRY,
    ChangeMap,
    Render,
    map_changes,
)
from chronoscene.harness.use.trained_run import TrainedRun
from chronoscene.images.store import ImageStore
from chronoscene.images.truth import check_distinct, load_changes, truth_place
from chronoscene.io.tables import Head, Table, csv_text
from chronoscene.metrics.change import change_scores
from chronoscene.scene import Frame, Scene

MAX_WIDTH = 640
"""Pixels: places lie farther apart than those of wider images."""

Compared = tuple[ChangeMap, Mapping[str, float]]
"""The map of a pair of periods, and its scores."""
SCORES = {
    f"{name}_{metric}_{kind}": (f"{metric.upper()} {kind}", name)
    for kind in ("geometry", "appearance")
    for metric in ("ap", "f1")
    for name in ("map", "image")
}
"""Keys of `score_map` with their headings, in the order of the table."""


def map_run(run: TrainedRun, scene: Scene, pairs: Sequence[tuple[int, int]]) -> Iterator[Compared]:
    """Yield the map of each pair of periods, with scores if ground truth is known.

    Args:
        run: The run.
        scene: The scene of the run.
        pairs: Pairs of periods in their order.

    Raises:
        ConfigError: If its models cannot tell periods apart, or give no depth.
        ImageError: If a file of the truth is damaged.
    """
    for pair in pairs:
        made = map_pair(run, scene, pair, render=run.render)
        yield made, score_map(run, scene, made)


def map_pair(run: TrainedRun, scene: Scene, pair: tuple[int, int], *, render: Render) -> ChangeMap:
    """Return the map of a pair of periods.

    Args:
        run: The run.
        scene: The scene of the run.
        pair: Periods in their order.
        render: Renders as the run does.

    Raises:
        ConfigError: As `map_run`.
    """
    if not run.distinguishes_periods:
        raise _unfit(run, "models that know the periods", "one that does not take the period")
    if "depth" not in run.spec.outputs:
        raise _unfit(run, "a method that renders depth", "one that does not")
    store = ImageStore(scene, max_width=_width(run))
    frames = {f.name: f for f in scene.select(split="train") if f.period in pair}
    viewpoints = [_viewpoint(store, frame) for frame in frames.values()]
    return map_changes(
        render, viewpoints, pair, load_mask=lambda view: store.load_mask(frames[view.name])
    )


def _unfit(run: TrainedRun, expected: str, found: str) -> ConfigError:
    return ConfigError(
        run.folder,
        expected=expected,
        found=f"{found}: {run.spec.title} under strategy {run.record.strategy}",
        todo="open another run, such as one of chronogs under strategy joint",
    )


def _width(run: TrainedRun) -> int:
    return min(run.record.max_width, MAX_WIDTH)


def _viewpoint(store: ImageStore, frame: Frame) -> Viewpoint:
    return Viewpoint(frame.name, store.camera(frame), frame.cam_from_world, frame.period)


def score_map(run: TrainedRun, scene: Scene, made: ChangeMap) -> dict[str, float]:
    """Score a map by its separation of changed and unchanged pixels of test views.

    The pixels of all views of the two periods are taken together. The baseline is the difference
    between the renders of both periods, with the threshold of Otsu.

    Returns:
        ``map_ap_geometry``, ``map_f1_geometry``, ``image_ap_geometry`` and so on; empty without
        a truth.
    """
    store = ImageStore(scene, max_width=_width(run))
    scores: list[Array] = []
    masks: list[Pixels] = []
    check_distinct(scene.root / "gt", (frame.name for frame in scene.select(split="test")))
    for frame in scene.select(split="test"):
        other = sum(made.periods) - frame.period
        path = scene.root / "gt" / truth_place("change", frame.name, other)
        if frame.period not in made.periods or not path.is_file():
            continue
        viewpoint, mask = _viewpoint(store, frame), store.load_mask(frame)
        changes = load_changes(path, viewpoint.camera.size, _width(run))
        shown = [run.render(viewpoint.camera, viewpoint.cam_from_world, p) for p in made.periods]
        first, second = (to_bytes(prediction.rgb).astype(int) for prediction in shown)
        difference = np.abs(first - second).mean(axis=2, keepdims=True).round()
        counted = np.ones(changes.shape, bool) if mask is None else mask
        view = np.concatenate([made.view_scores(viewpoint, shown), difference], axis=2)
        scores.append(view[counted])
        masks.append(changes[counted])
    if not any(map(len, masks)):
        return {}
    geometry, appearance, image = np.concatenate(scores).T
    truth = np.concatenate(masks)
    otsu, _ = cv2.threshold(image.astype(np.uint8), 0, 255, cv2.THRESH_OTSU)
    by_map = {
        "geometry": change_scores(geometry, truth, threshold=GEOMETRY),
        "appearance": change_scores(appearance, truth, threshold=APPEARANCE),
    }
    by_image = change_scores(image, truth, threshold=otsu + 1)
    return {
        f"{name}_{metric}_{kind}": values[f"change_{metric}_{kind}"]
        for kind in by_map
        for name, values in (("map", by_map[kind]), ("image", by_image))
        for metric in ("ap", "f1")
        if f"change_{metric}_{kind}" in values
    }


def changes_table(rows: Sequence[Compared], labels: Mapping[str, str], title: str) -> Table:
    """Return a table with a row for each pair of periods.

    Args:
        rows: Result of `map_run`.
        labels: Labels of the periods by their ids.
        title: Title of the table.
    """
    shown = [key for key in SCORES if any(key in scores for _, scores in rows)]
    heads: list[Head] = ["from", "to", "places"]
    groups = {"unknown": "of them [%]", "gone": "of its period [%]"}
    heads += [(groups.get(name, ""), name) for name in CLASSES[1:]]
    heads += [SCORES[key] for key in shown]
    lines = []
    for made, scores in rows:
        names = [labels[str(period)] for period in made.periods]
        shares = [f"{100 * share:.1f}" for share in made.shares().values()]
        values = [f"{scores[key]:.3f}" if key in scores else "-" for key in shown]
        lines.append([*names, f"{len(made.xyz):,}", *shares, *values])
    return Table(heads, lines, labels=2, title=title)


def changes_csv(rows: Sequence[Compared]) -> str:
    """Return the rows as CSV: numbers of periods, shares instead of percentages, all digits."""
    columns = ("from", "to", "places", *CLASSES[1:], *SCORES)
    lines = [
        (*made.periods, len(made.xyz), *made.shares().values(), *(scores.get(k) for k in SCORES))
        for made, scores in rows
    ]
    return csv_text(columns, lines)
