"""Points on the surfaces of a period, facades included.

The rule by which they are kept is that of COLMAP's fusion of depth maps, with its default values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.harness.use.changes import back_project
from chronoscene.scene import Scene
from chronoscene.scene.geometry import camera_centre
from chronoscene.survey.grid import Grid
from chronoscene.survey.map_frame import MapFrame
from chronoscene.survey.views import DepthView, look

AGREE = 0.01  # Relative difference of depth up to which photos agree on a point
MIN_VIEWS = 5  # Photos that must agree on a point, or half of the photos if that is less


@dataclass(frozen=True, slots=True, eq=False)
class PointCloud:
    """Points of one period in map coordinates."""

    xyz: Array
    """[N, 3]"""
    rgb: NDArray[np.uint8]
    """[N, 3]"""
    to_camera: Array
    """Vector to a camera that sees the point. [N, 3]"""
    spread: Array
    """Standard deviation along the rays of the photos that agree, metres; NaN if unknown. [N]"""

    def __len__(self) -> int:
        return len(self.xyz)

    def select(self, keep: Mask | Ints) -> Self:
        """Keep some of the points."""
        return type(self)(*(getattr(self, f.name)[keep] for f in fields(self)))

    def thinned(self, spacing: float) -> Self:
        """Keep one point of each cube of this edge."""
        if not len(self):
            return self
        # Ranks instead of cubes: one point far away makes more cubes than can be numbered.
        ranks = [np.unique(c, return_inverse=True)[1] for c in np.floor(self.xyz / spacing).T]
        numbers = np.ravel_multi_index(ranks, [rank.max() + 1 for rank in ranks])
        return self.select(np.sort(np.unique(numbers, return_index=True)[1]))


def dense_cloud(views: Sequence[DepthView], frame: MapFrame, grid: Grid) -> PointCloud:
    """Place the pixels of the training photos of a period at their depths, one in each cube with
    the edge of a cell; keep what several photos agree on."""
    none = np.zeros((0, 3))
    parts = [PointCloud(none, none.astype(np.uint8), none, np.zeros(0))]  # there may be no photos
    parts += [_points_of(view, frame, grid).thinned(grid.resolution) for view in views]
    joined = [np.concatenate([getattr(p, f.name) for p in parts]) for f in fields(PointCloud)]
    cloud = PointCloud(*joined).thinned(grid.resolution)
    count, spread = look(frame.to_world(cloud.xyz), views, AGREE)
    whole = PointCloud(cloud.xyz, cloud.rgb, cloud.to_camera, spread)
    return whole.select(count >= min(MIN_VIEWS, max(2, len(views) // 2)))


def _points_of(view: DepthView, frame: MapFrame, grid: Grid) -> PointCloud:
    xyz = frame.to_map(back_project(view.depth.astype(np.float64), view.viewpoint))
    towards = frame.to_map(camera_centre(view.viewpoint.cam_from_world)[None]) - xyz
    whole = PointCloud(xyz, view.rgb[np.isfinite(view.depth)], towards, np.full(len(xyz), np.nan))
    return whole.select(grid.holds(xyz))


def sparse_cloud(scene: Scene, period: int, frame: MapFrame, *, alone: bool = False) -> PointCloud:
    """Take the sparse points that a period sees; if ``alone``, only those that no other sees."""
    seen = scene.point_periods()
    keep = seen[:, period] & ((seen.sum(axis=1) == 1) | (not alone))
    xyz = frame.to_map(scene.points.xyz[keep])
    poses = np.stack([f.cam_from_world for f in scene.select(period=period)])
    towards = frame.to_map(camera_centre(poses)).mean(axis=0) - xyz
    return PointCloud(xyz, scene.points.rgb[keep], towards, np.full(len(xyz), np.nan))
