"""What the cameras of a period have in view of the points of another one."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Camera, Frame, Scene
from chronoscene.scene.cameras import project_points

Array = NDArray[np.float64]

MAX_POINTS, MIN_POINTS_PER_PERIOD = 4000, 400
"""Points of all periods together that are looked for, and of each: a share is known to a percent or
two."""
DEPTH_PERCENTILE, REACH_FACTOR = 95.0, 1.5
"""Percentile of the depths at which the images of a period see points, and how many times as far
they could see some."""
DIRECTIONS, MAX_TANGENT, STEPS = 8, 4.0, 400
"""Where lenses are tried: so many directions, up to this hypot(x, y) / z, in so many steps."""


def common_view(
    scene: Scene, seen: NDArray[np.bool_], depths: Array
) -> tuple[tuple[float | None, ...], ...]:
    """Share of the points of each period that the cameras of each have in view.

    A point is in view if it lies in front of a camera, inside of its image, and not much farther
    than what the camera's period sees. Whether something hides it is not known.

    Args:
        scene: The scene.
        seen: Whether images of a period see a point. [P, T]
        depths: Of every observation; NaN where there is none. [M]

    Returns:
        Row a, column b: of the points that period a sees, those that b has in view; None if a sees
        no point. [T, T]
    """
    periods = seen.shape[1]
    count = max(MAX_POINTS // periods, MIN_POINTS_PER_PERIOD)
    chosen = [_evenly(np.flatnonzero(column), count) for column in seen.T]
    owner = np.repeat(np.arange(periods), [len(rows) for rows in chosen])
    counts = np.bincount(owner, minlength=periods)
    xyz = scene.points.xyz[np.concatenate(chosen)]
    reach = _reach(scene, depths)
    shares = np.full((periods, periods), np.nan)
    for p in range(periods):
        if np.isfinite(reach[p]):
            viewed = _viewed(scene.select(period=p), xyz, reach[p])
            shares[:, p] = np.bincount(owner[viewed], minlength=periods) / np.maximum(counts, 1)
    shares[counts == 0] = np.nan
    return tuple(tuple(None if np.isnan(x) else float(x) for x in row) for row in shares)


def _viewed(frames: Sequence[Frame], xyz: Array, reach: float) -> NDArray[np.bool_]:
    """Which points any of the frames has in view. [n, 3] -> [n]"""
    viewed = np.zeros(len(xyz), bool)
    cameras = {f.camera.camera_id: f.camera for f in frames}
    limits = {key: _limit(camera) for key, camera in cameras.items()}
    with np.errstate(all="ignore"):  # absurd poses and points are in no view
        for frame in frames:
            left = np.flatnonzero(~viewed)
            local = xyz[left] @ frame.cam_from_world[:3, :3].T + frame.cam_from_world[:3, 3]
            ahead = np.flatnonzero((local[:, 2] > 0) & (local[:, 2] <= reach))
            inside = _inside(frame.camera, local[ahead], limits[frame.camera.camera_id])
            viewed[left[ahead[inside]]] = True
    return viewed


def _evenly(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most ``count`` of them, evenly spread."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]


def _reach(scene: Scene, depths: Array) -> Array:
    """Depth up to which the images of each period see; that of all if they see nothing. [T]"""
    period = np.array([f.period for f in scene.frames], np.int64)[scene.points.track_frame]
    ahead = np.isfinite(depths)
    if not ahead.any():
        return np.full(scene.num_periods, np.nan)
    mine = [depths[ahead & (period == p)] for p in range(scene.num_periods)]
    return np.array(
        [
            REACH_FACTOR * np.percentile(d if len(d) else depths[ahead], DEPTH_PERCENTILE)
            for d in mine
        ]
    )


def _limit(camera: Camera) -> float:
    """The obliqueness, hypot(x, y) / z, up to which a camera maps what is farther out farther out.

    Beyond, the polynomials of lenses turn back, and map what is far outside into the image.
    """
    if camera.is_pinhole:
        return np.inf
    angle = np.arange(DIRECTIONS)[:, None] * (2 * np.pi / DIRECTIONS)
    tangent = np.linspace(0, MAX_TANGENT, STEPS)
    x, y = np.cos(angle) * tangent, np.sin(angle) * tangent
    u, v = project_points(camera, np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1)).T
    u, v = u.reshape(x.shape), v.reshape(x.shape)
    outward = np.diff(np.hypot(u - u[:, :1], v - v[:, :1]), axis=1) > 0
    return float(tangent[outward.all(axis=0).argmin()]) if not outward.all() else np.inf


def _inside(camera: Camera, local: Array, limit: float) -> NDArray[np.bool_]:
    """Which points in front of a camera are in its image. [n, 3] -> [n]"""
    u, v = project_points(camera, local).T
    inside = (u >= 0) & (v >= 0) & (u <= camera.width) & (v <= camera.height)
    if np.isfinite(limit):
        inside &= np.hypot(local[:, 0], local[:, 1]) <= limit * local[:, 2]
    return np.asarray(inside)
