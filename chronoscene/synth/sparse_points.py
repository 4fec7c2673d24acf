"""Sparse points: points on surfaces, with tracks over the training frames that see them.

Every observation is confirmed by the ray caster.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.images.decoding import load_rgb
from chronoscene.scene import Frame, Points, Scene
from chronoscene.synth.render.mesh import MISS
from chronoscene.synth.render.noise import rng_for
from chronoscene.synth.render.renderer import PeriodRenderer
from chronoscene.synth.settings import SynthSettings

MIN_TRACK_LENGTH = 3
MAX_TRACK_LENGTH = 14
CANDIDATES_PER_POINT = 1.7  # Candidates per requested point; many are seen by too few frames
MAX_ALBEDO_CHANGE = 0.003  # Maximum albedo difference between periods that share a point
MAX_DEPTH = 450.0  # Metres; more distant points are not useful
ROWS = 4096  # Points whose tracks are chosen at a time: a number for each frame of each is drawn


class Candidates(NamedTuple):
    """Surface points and the objects they lie on (N points)."""

    xyz: Array
    """[N, 3]"""
    period: NDArray[np.int64]
    """Period in which the point was found. [N]"""
    element: NDArray[np.int32]
    """Object. [N]"""
    albedo: Array
    """Full detail. [N, 3]"""


class Sightings(NamedTuple):
    """Points that a frame sees (M points)."""

    rows: NDArray[np.int64]
    """Their rows among all, ascending. [M]"""
    xy: Array
    """Their pixels. [M, 2]"""

    def select(self, keep: NDArray[np.int64]) -> Sightings:
        """Return those of some points, by their rows among these; ``keep`` is ascending."""
        kept = np.isin(self.rows, keep, assume_unique=True)
        return Sightings(np.searchsorted(keep, self.rows[kept]), self.xy[kept])


def make_points(
    settings: SynthSettings, scene: Scene, renderers: Sequence[PeriodRenderer]
) -> Points:
    """Points, tracks and colours.

    Args:
        settings: Number of points, seed, noise.
        scene: Frames and their images; only training frames contribute points and colours.
        renderers: One per period.
    """
    if settings.points == 0:
        return Points.empty()
    rng = rng_for(settings.seed, "points")
    train = [i for i, f in enumerate(scene.frames) if f.split == "train"]
    frames = [scene.frames[i] for i in train]
    # Photos are decoded twice: hundreds of large ones would not fit into memory together.
    photos = [scene.image_path(f) for f in frames]
    count = int(np.ceil(CANDIDATES_PER_POINT * settings.points / len(frames)))
    found = [
        _candidates(renderers[frame.period], frame, load_rgb(photo), count, rng)
        for frame, photo in zip(frames, photos, strict=True)
    ]
    candidates = Candidates(*map(np.concatenate, zip(*found, strict=True)))
    views = _visibility(candidates, frames, renderers)
    numbers = np.bincount(np.concatenate([view.rows for view in views]))
    keep = np.flatnonzero(numbers >= MIN_TRACK_LENGTH)
    if len(keep) > settings.points:
        keep = np.sort(rng.choice(keep, settings.points, replace=False))
    if len(keep) == 0:
        return Points.empty()
    views = [view.select(keep) for view in views]
    size = frames[0].camera.size
    points = _assemble(candidates.xyz[keep], views, photos, size, settings.noise, rng)
    return replace(points, track_frame=np.array(train, np.int32)[points.track_frame])


def _candidates(
    renderer: PeriodRenderer,
    frame: Frame,
    image: NDArray[np.uint8],
    count: int,
    rng: np.random.Generator,
) -> Candidates:
    """Random surface points in a frame, preferably where the image has texture."""
    gray = image.astype(np.float64).mean(axis=2)
    slope = np.hypot(*np.gradient(gray))
    weight = (3.0 + np.minimum(slope, 40.0)).ravel()
    pick = rng.choice(weight.size, count, p=weight / weight.sum())
    width = frame.camera.width
    xy = np.stack([pick % width, pick // width], axis=1) + rng.random((count, 2))
    local = np.column_stack([xy, np.ones(count)]) @ np.linalg.inv(frame.camera.K).T
    world_from_cam = np.linalg.inv(frame.cam_from_world)
    rays = _rays(world_from_cam[:3, 3], local @ world_from_cam[:3, :3].T)
    hits = renderer.surfaces.cast(rays)
    good = (hits.tri != MISS) & (hits.t < MAX_DEPTH)
    xyz = rays[:, :3].astype(np.float64) + hits.t[:, None].astype(np.float64) * rays[:, 3:]
    albedo = renderer.albedo(rays, hits, np.zeros(count))
    period = np.full(count, frame.period)
    return Candidates(xyz[good], period[good], renderer.elements_of(hits.tri)[good], albedo[good])


def _rays(origin: NDArray[np.floating], directions: NDArray[np.floating]) -> NDArray[np.float32]:
    """Rays from one point. [n, 6]"""
    rays = np.empty((len(directions), 6), np.float32)
    rays[:, :3], rays[:, 3:] = origin, directions
    return rays


def _visibility(
    candidates: Candidates, frames: Sequence[Frame], renderers: Sequence[PeriodRenderer]
) -> list[Sightings]:
    """Find the points that each frame sees."""
    found = []
    same = _unchanged(candidates, renderers)
    for frame in frames:
        camera, k = frame.camera, frame.camera.K
        local = candidates.xyz @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            at = local[:, :2] / local[:, 2:] * [k[0, 0], k[1, 1]] + k[:2, 2]
        inside = (local[:, 2] > 0.1) & np.all((at >= 0) & (at < [camera.width, camera.height]), 1)
        rows = np.flatnonzero(inside & same[:, frame.period])
        # A point is seen if the ray to it ends there, on the same object.
        renderer, depth = renderers[frame.period], local[rows, 2]
        centre = np.linalg.inv(frame.cam_from_world)[:3, 3]
        hits = renderer.surfaces.cast(
            _rays(centre, (candidates.xyz[rows] - centre) / depth[:, None])
        )
        close = np.abs(hits.t - depth) < 1e-4 * depth + 1e-3
        seen = close & (renderer.elements_of(hits.tri) == candidates.element[rows])
        found.append(Sightings(rows[seen], at[rows[seen]]))
    return found


def _unchanged(candidates: Candidates, renderers: Sequence[PeriodRenderer]) -> NDArray[np.bool_]:
    """Mask of the periods in which the surface at a point is the same but for the light. [N, T]"""
    same = np.zeros((len(candidates.xyz), len(renderers)), bool)
    for period, renderer in enumerate(renderers):
        found = renderer.surface_near(candidates.xyz)
        albedo = renderer.albedo_on(candidates.xyz, found)
        close = np.abs(albedo - candidates.albedo).max(axis=1) < MAX_ALBEDO_CHANGE
        same[:, period] = close & (renderer.elements_of(found) == candidates.element)
        same[candidates.period == period, period] = True
    return same


def _assemble(
    xyz: Array,
    views: Sequence[Sightings],
    photos: Sequence[Path],
    size: tuple[int, int],
    noise: float,
    rng: np.random.Generator,
) -> Points:
    """Choose a random subset of each track and average its colours.

    Args:
        xyz: Points that enough frames see. [N, 3]
        views: Those that each of the F training frames sees.
        photos: Their images.
        size: Width and height of these.
        noise: Standard deviation of the noise on observations, in pixels.
        rng: Draws the subsets and the noise.
    """
    rows, columns, length = _choose(len(xyz), views, rng)
    start = np.concatenate([[0], np.cumsum(length)])
    where, color = np.zeros((len(rows), 2)), np.zeros((len(rows), 3))
    for column, (view, photo) in enumerate(zip(views, photos, strict=True)):
        mine = np.flatnonzero(columns == column)
        where[mine] = view.xy[np.searchsorted(view.rows, rows[mine])]
        cell = np.floor(where[mine]).astype(int)
        color[mine] = load_rgb(photo)[cell[:, 1], cell[:, 0]]
    shift = rng.normal(0, noise, where.shape) if noise > 0 else np.zeros_like(where)
    shift = np.clip(where + shift, 0, np.array(size) - 1e-6) - where
    error = np.add.reduceat(np.hypot(*shift.T), start[:-1]) / length
    mean = np.add.reduceat(color, start[:-1]) / length[:, None]
    return Points(
        ids=np.arange(1, len(xyz) + 1),
        xyz=xyz,
        rgb=np.round(mean).astype(np.uint8),
        error=error,
        track_start=start.astype(np.int64),
        track_frame=columns.astype(np.int32),
        track_xy=where + shift,
    )


def _choose(
    count: int, views: Sequence[Sightings], rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Choose observations of points; return point and frame of each, and how many each point has.

    They are sorted by point and frame.
    """
    wanted = np.minimum(MIN_TRACK_LENGTH + rng.geometric(0.28, count) - 1, MAX_TRACK_LENGTH)
    seers = np.repeat(np.arange(len(views)), [len(view.rows) for view in views])
    seen_rows = np.concatenate([view.rows for view in views])
    order = np.argsort(seen_rows, kind="stable")
    seen_rows, seers = seen_rows[order], seers[order]
    parts = []
    for first in range(0, count, ROWS):
        last = min(first + ROWS, count)
        a, b = np.searchsorted(seen_rows, [first, last])
        row, column = seen_rows[a:b], seers[a:b]
        # The observations of a point with the smallest of random keys are a random subset.
        keys = rng.random((last - first, len(views)))[row - first, column]
        sorted_ = np.lexsort((keys, row))
        row, column = row[sorted_], column[sorted_]
        rank = np.arange(len(row)) - np.searchsorted(row, row)
        chosen = rank < wanted[row]
        parts.append((row[chosen], column[chosen]))
    rows, columns = (np.concatenate(x) for x in zip(*parts, strict=True))
    by_view = np.lexsort((columns, rows))
    rows, columns = rows[by_view], columns[by_view]
    return rows, columns, np.bincount(rows, minlength=count)
