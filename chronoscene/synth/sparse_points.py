"""Sparse points with honest tracks: surface points, and the training views that see them.

Tests re-cast every observation: a track never claims more than the ray caster confirms.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Camera, Points
from chronoscene.synth.flights import View
from chronoscene.synth.render.mesh import MISS
from chronoscene.synth.render.noise import rng_for
from chronoscene.synth.render.renderer import PeriodRenderer
from chronoscene.synth.settings import SynthSettings

Array = NDArray[np.float64]

MIN_TRACK = 3
MAX_TRACK = 14
SPARE = 1.7
"""Candidates per wanted point; many are seen by too few views."""
SAME_ALBEDO = 0.003
"""Largest difference of albedo between periods that share a point."""
MAX_DEPTH = 450.0
"""Metres; farther points have no use."""


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Surface points and what they lie on (N points)."""

    xyz: Array
    """[N, 3]"""
    period: NDArray[np.int64]
    """Where the point was found. [N]"""
    element: NDArray[np.int32]
    """Object. [N]"""
    albedo: Array
    """Full detail. [N, 3]"""


def make_points(
    settings: SynthSettings,
    renderers: Sequence[PeriodRenderer],
    camera: Camera,
    views: Sequence[View],
    images: Path,
) -> Points:
    """Points, tracks and colours.

    Args:
        settings: Number of points, seed, noise.
        renderers: One per period.
        camera: Shared camera.
        views: All views, sorted by name; only training views take part.
        images: Folder of the written images; colours are those of the files.
    """
    if settings.points == 0:
        return Points.empty()
    rng = rng_for(settings.seed, "points")
    train = [i for i, v in enumerate(views) if v.split == "train"]
    quota = int(np.ceil(SPARE * settings.points / len(train)))
    pixels = {i: _read(images / views[i].name) for i in train}
    found = [
        _candidates(renderers[views[i].period], camera, views[i], pixels[i], quota, rng)
        for i in train
    ]
    some = Candidates(*(np.concatenate([getattr(c, k) for c in found]) for k in _FIELDS))
    seen, xy = _visibility(some, renderers, camera, views, train)
    keep = np.flatnonzero(seen.sum(axis=1) >= MIN_TRACK)
    if len(keep) > settings.points:
        keep = np.sort(rng.choice(keep, settings.points, replace=False))
    return _assemble(some.xyz[keep], seen[keep], xy[keep], train, pixels, settings.noise, rng)


_FIELDS = ("xyz", "period", "element", "albedo")


def _read(path: Path) -> NDArray[np.uint8]:
    image = cv2.imread(str(path))
    assert image is not None
    return np.asarray(image[..., ::-1])


def _candidates(
    renderer: PeriodRenderer,
    camera: Camera,
    view: View,
    image: NDArray[np.uint8],
    count: int,
    rng: np.random.Generator,
) -> Candidates:
    """Random surface points in a view, mostly where the image has texture."""
    gray = image.astype(np.float64).mean(axis=2)
    slope = np.hypot(*np.gradient(gray))
    weight = (3.0 + np.minimum(slope, 40.0)).ravel()
    pick = rng.choice(weight.size, count, p=weight / weight.sum())
    xy = np.stack([pick % camera.width, pick // camera.width], axis=1) + rng.random((count, 2))
    rays = _rays(camera, view.cam_from_world, xy)
    hits = renderer.cast(rays)
    good = (hits.tri != MISS) & (hits.t < MAX_DEPTH)
    xyz = rays[:, :3].astype(np.float64) + hits.t[:, None].astype(np.float64) * rays[:, 3:]
    albedo = renderer.albedo(rays, hits, np.zeros(count))
    period = np.full(count, view.period)
    return Candidates(xyz[good], period[good], renderer.elements(hits)[good], albedo[good])


def _rays(camera: Camera, cam_from_world: Array, xy: Array) -> NDArray[np.float32]:
    """Rays with unit z in the camera through pixel positions. [n, 6]"""
    local = np.column_stack([xy, np.ones(len(xy))]) @ np.linalg.inv(camera.K).T
    world_from_cam = np.linalg.inv(cam_from_world)
    rays = np.empty((len(xy), 6), np.float32)
    rays[:, :3] = world_from_cam[:3, 3]
    rays[:, 3:] = local @ world_from_cam[:3, :3].T
    return rays


def _visibility(
    some: Candidates,
    renderers: Sequence[PeriodRenderer],
    camera: Camera,
    views: Sequence[View],
    train: Sequence[int],
) -> tuple[NDArray[np.bool_], Array]:
    """Which training views see which points, and where. [N, V], [N, V, 2]"""
    seen = np.zeros((len(some.xyz), len(train)), bool)
    xy = np.zeros((len(some.xyz), len(train), 2))
    same = _unchanged(some, renderers)
    for column, i in enumerate(train):
        view = views[i]
        local = some.xyz @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = local[:, :2] / local[:, 2:] * [camera.K[0, 0], camera.K[1, 1]] + camera.K[:2, 2]
        inside = (local[:, 2] > 0.1) & np.all((at >= 0) & (at < [camera.width, camera.height]), 1)
        rows = np.flatnonzero(inside & same[:, view.period])
        seen[rows, column] = _hit(renderers[view.period], some, rows, view, local[rows, 2])
        xy[rows, column] = at[rows]
    return seen, xy


def _hit(
    renderer: PeriodRenderer,
    some: Candidates,
    rows: NDArray[np.int64],
    view: View,
    depth: Array,
) -> NDArray[np.bool_]:
    """Whether the ray from a camera to each point ends there, on the same object. [n]"""
    centre = np.linalg.inv(view.cam_from_world)[:3, 3]
    rays = np.empty((len(rows), 6), np.float32)
    rays[:, :3] = centre
    rays[:, 3:] = (some.xyz[rows] - centre) / depth[:, None]
    hits = renderer.cast(rays)
    close = np.abs(hits.t - depth) < 1e-4 * depth + 1e-3
    return np.asarray(close & (renderer.elements(hits) == some.element[rows]))


def _unchanged(some: Candidates, renderers: Sequence[PeriodRenderer]) -> NDArray[np.bool_]:
    """Whether a point's piece of surface looks the same in each period, but for light. [N, T]

    A short probe along the sight line that found the point asks what lies there in the period.
    """
    same = np.zeros((len(some.xyz), len(renderers)), bool)
    for period, renderer in enumerate(renderers):
        found = renderer.surface_near(some.xyz)
        albedo = renderer.albedo_on(some.xyz, found)
        close = np.abs(albedo - some.albedo).max(axis=1) < SAME_ALBEDO
        same[:, period] = close & (renderer.elements_of(found) == some.element)
        same[some.period == period, period] = True
    return same


def _assemble(
    xyz: Array,
    seen: NDArray[np.bool_],
    xy: Array,
    train: Sequence[int],
    pixels: dict[int, NDArray[np.uint8]],
    noise: float,
    rng: np.random.Generator,
) -> Points:
    """Choose a random subset of each track and average its colours."""
    total = seen.sum(axis=1)
    wanted = np.minimum(MIN_TRACK + rng.geometric(0.28, len(xyz)) - 1, MAX_TRACK)
    # Random keys, unseen last: the first entries of the sorted row are a random subset.
    keys = np.where(seen, rng.random(seen.shape), 2.0)
    order = np.argsort(keys, axis=1)
    length = np.minimum(total, wanted)
    rows = np.repeat(np.arange(len(xyz)), length)
    start = np.concatenate([[0], np.cumsum(length)])
    columns = order[rows, np.arange(len(rows)) - start[rows]]
    by_view = np.lexsort((columns, rows))
    rows, columns = rows[by_view], columns[by_view]
    where = xy[rows, columns]
    color = np.zeros((len(rows), 3))
    for column, i in enumerate(train):
        mine = columns == column
        cell = np.floor(where[mine]).astype(int)
        color[mine] = pixels[i][cell[:, 1], cell[:, 0]]
    shift = rng.normal(0, noise, where.shape) if noise > 0 else np.zeros_like(where)
    high, width = pixels[train[0]].shape[:2]
    shift = np.clip(where + shift, 0, np.array([width, high]) - 1e-6) - where
    error = np.add.reduceat(np.hypot(*shift.T), start[:-1]) / length
    mean = np.add.reduceat(color, start[:-1]) / length[:, None]
    return Points(
        ids=np.arange(1, len(xyz) + 1),
        xyz=xyz,
        rgb=np.round(mean).astype(np.uint8),
        error=error,
        track_start=start.astype(np.int64),
        track_frame=np.array(train, np.int32)[columns],
        track_xy=where + shift,
    )
