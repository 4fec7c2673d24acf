"""What the cameras of a period have in view of the points of another one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Scene
from chronoscene.scene.tracks import common_view

Array = NDArray[np.float64]

MAX_POINTS, MIN_POINTS_PER_PERIOD = 4000, 400
"""Points of all periods together that are looked for, and of each: a share is known to a percent or
two."""
DEPTH_PERCENTILE, REACH_FACTOR = 95.0, 1.5
"""Percentile of the depths at which the images of a period see points, and how many times as far
they could see some."""


def in_view(
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
    views = [[(f.camera, f.cam_from_world) for f in scene.select(period=p)] for p in range(periods)]
    shares = common_view(
        scene.points.xyz[np.concatenate(chosen)], owner, views, _reach(scene, depths)
    )
    return tuple(tuple(None if np.isnan(x) else float(x) for x in row) for row in shares)


def _evenly(rows: NDArray[np.int64], count: int) -> NDArray[np.int64]:
    """At most ``count`` of them, evenly spread."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]


def _reach(scene: Scene, depths: Array) -> Array:
    """Depth up to which the images of each period see; that of all if they see nothing. [T]"""
    period = scene.frame_periods[scene.points.track_frame]
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
