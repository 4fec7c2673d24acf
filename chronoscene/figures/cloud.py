"""Points and cameras that figures and pages show, and the part of space that is shown."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.figures import canvas
from chronoscene.io.wording import printable
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.statistics.counts import assign_points, period_name
from chronoscene.statistics.measures import robust_range

MARGIN = 0.03  # Of the longest edge, on every side
MIN_EDGE = 0.18  # Of the longest edge: a flat scene gets space above and below it


@dataclass(frozen=True, slots=True)
class Box:
    """Box of the world that is shown."""

    low: Array
    """[3]"""
    high: Array
    """[3]"""

    @property
    def edges(self) -> Array:
        return self.high - self.low

    def holds(self, xyz: Array) -> NDArray[np.bool_]:
        """Return True for places inside. [n, 3] -> [n]"""
        with np.errstate(invalid="ignore"):
            return np.asarray(((xyz >= self.low) & (xyz <= self.high)).all(axis=1))


@dataclass(frozen=True, slots=True, eq=False)
class Cloud:
    """Points and cameras of a scene."""

    name: str
    unit: str
    labels: tuple[str, ...]
    """Names of the periods; a number where nothing else is known."""
    xyz: Array
    """[P, 3]"""
    period: NDArray[np.int64]
    """Period that each point is counted in; -1 for points that no image sees. [P]"""
    centres: Array
    """Camera centres. [C, 3]"""
    directions: Array
    """Viewing directions. [C, 3]"""
    tops: Array
    """Directions that are up in the images. [C, 3]"""
    camera_period: NDArray[np.int64]
    """[C]"""

    def groups(self) -> tuple[NDArray[np.int64], list[str]]:
        """Return the group of each point [P], and the colours of all groups: the periods and, if
        there are any, the points that no image sees."""
        colors, unseen = canvas.period_colors(len(self.labels)), self.period < 0
        if not unseen.any():
            return self.period, colors
        return np.where(unseen, len(colors), self.period), [*colors, canvas.UNSEEN_COLOR]


def cloud_of(scene: Scene) -> Cloud:
    """Collect the points and cameras of a scene."""
    poses = scene.frame_poses
    return Cloud(
        name=printable(scene.name),
        unit=scene.world.unit,
        labels=tuple(printable(period_name(p.id, p.label, p.date)) for p in scene.periods),
        xyz=scene.points.xyz,
        period=assign_points(scene.count_views()),
        centres=camera_centre(poses),
        directions=poses[:, 2, :3],
        tops=-poses[:, 1, :3],
        camera_period=scene.frame_periods,
    )


def shown_box(cloud: Cloud, *, cameras: bool) -> Box:
    """Find robust limits of the points (and of the cameras), wide enough for a readable panel.

    Points that no image sees count if there are no others, as of a laser scan.
    """
    finite = np.isfinite(cloud.xyz).all(axis=1)
    seen = finite & (cloud.period >= 0)
    good = seen if seen.any() else finite
    corners = robust_range(cloud.xyz[good]) if good.any() else np.zeros((0, 3))
    if cameras or not len(corners):
        known = cloud.centres[np.isfinite(cloud.centres).all(axis=1)]
        corners = np.concatenate([corners, robust_range(known if len(known) else np.zeros((1, 3)))])
    low, high = corners.min(axis=0), corners.max(axis=0)
    longest = float((high - low).max()) or 1.0
    middle = (low + high) / 2
    half = np.maximum((high - low) / 2 + MARGIN * longest, MIN_EDGE * longest / 2)
    return Box(middle - half, middle + half)
