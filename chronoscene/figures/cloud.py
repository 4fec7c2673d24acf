"""What figures and pages show of a scene, and how far they reach."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.geometry import camera_centre
from chronoscene.scene import Scene
from chronoscene.stats.counts import assign_points

Array = NDArray[np.float64]

ROBUST = (2.0, 98.0)
"""Percentiles of the points that the panels show, and `BEYOND` that; strays are left out, and
counted."""
BEYOND = 0.08
"""Of the distance between the two: an even spread of points is shown to its ends."""
MARGIN = 0.03
"""Of the longest edge, on every side."""
SMALLEST_EDGE = 0.18
"""Of the longest edge: a flat scene gets room above and below it."""


@dataclass(frozen=True, slots=True)
class Box:
    """What is shown of the world."""

    low: Array
    """[3]"""
    high: Array
    """[3]"""

    @property
    def edges(self) -> Array:
        return self.high - self.low


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """What is drawn of a scene."""

    name: str
    unit: str
    labels: tuple[str, ...]
    """Of the periods."""
    xyz: Array
    """[P, 3]"""
    period: NDArray[np.int64]
    """That each point is counted in; -1 for points that no image sees. [P]"""
    centres: Array
    """Of the cameras. [C, 3]"""
    directions: Array
    """Viewing directions. [C, 3]"""
    tops: Array
    """Directions that are up in the images. [C, 3]"""
    camera_period: NDArray[np.int64]
    """[C]"""


def cloud_of(scene: Scene) -> Cloud:
    """The points and cameras of a scene."""
    poses = np.stack([f.cam_from_world for f in scene.frames])
    return Cloud(
        name=scene.name,
        unit=scene.world.unit,
        labels=tuple(p.label for p in scene.periods),
        xyz=scene.points.xyz,
        period=assign_points(scene),
        centres=camera_centre(poses),
        directions=poses[:, 2, :3],
        tops=-poses[:, 1, :3],
        camera_period=np.array([f.period for f in scene.frames], np.int64),
    )


def shown_box(cloud: Cloud, *, cameras: bool) -> Box:
    """Robust limits of the points (and of the cameras), wide enough for a readable panel."""
    good = (cloud.period >= 0) & np.isfinite(cloud.xyz).all(axis=1)
    corners = _robust_range(cloud.xyz[good]) if good.any() else np.zeros((0, 3))
    if cameras or not len(corners):
        corners = np.concatenate([corners, _robust_range(cloud.centres)])
    low, high = corners.min(axis=0), corners.max(axis=0)
    longest = float((high - low).max()) or 1.0
    middle = (low + high) / 2
    half = np.maximum((high - low) / 2 + MARGIN * longest, SMALLEST_EDGE * longest / 2)
    return Box(middle - half, middle + half)


def _robust_range(xyz: Array) -> Array:
    """Ends without strays, per axis. [2, 3]"""
    low, high = np.percentile(xyz, ROBUST, axis=0)
    beyond = BEYOND * (high - low)
    return np.stack(
        [np.maximum(low - beyond, xyz.min(axis=0)), np.minimum(high + beyond, xyz.max(axis=0))]
    )
