"""Tracks, reprojection error, overlap, baseline and coverage of the periods of a scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Scene, tracks
from chronoscene.scene.geometry import camera_centre
from chronoscene.stats.counts import CountRule, SceneCount, count_scene
from chronoscene.stats.view_overlap import in_view

Array = NDArray[np.float64]
Index = NDArray[np.int64]

CELLS = 50
"""Cubes along the longest edge of a scene for its coverage."""


@dataclass(frozen=True, slots=True)
class Measures:
    """Of one period, or of a whole scene. None where there is nothing to measure."""

    points_seen: int
    """Points that images of the period see, however the points are counted."""
    observations: int
    """Of points by images of the period."""
    track_mean: float | None
    """Images of the period that see a point, mean over the points that any of them sees."""
    track_median: float | None
    reprojection_error: float | None
    """Mean over the observations of the distance between observation and projection, in pixels of
    the camera. Observations behind the camera are left out."""
    baseline: float | None
    """Distance from a camera to the nearest other one of the period, as a share of the median depth
    of the points that it sees; median over the cameras that see any."""
    coverage: float | None
    """Share of the scene's space with points in which the period sees a point: of the cubes with
    points of a grid that has 50 cubes along the scene's longest edge, without outliers."""


@dataclass(frozen=True, slots=True)
class SceneStatistics:
    """Everything that ``chronoscene stats`` knows about a scene."""

    counts: SceneCount
    periods: tuple[Measures, ...]
    whole: Measures
    """Tracks over all periods; cameras compared within their periods."""
    overlap: tuple[tuple[float | None, ...], ...]
    """Row a, column b: share of the points that period a sees which period b sees, too. [T, T]"""
    in_view: tuple[tuple[float | None, ...], ...]
    """Row a, column b: share of the points that period a sees which cameras of period b have in
    view, whether b sees them or not; see `chronoscene.stats.view_overlap`. [T, T]"""
    unit: str
    """Of the world: ``metre`` or ``unknown``."""


def measure_scene(scene: Scene, *, count: CountRule = "assigned") -> SceneStatistics:
    """Count and measure a scene; ``count`` is that of `count_scene`."""
    seen = scene.count_views()
    periods = scene.frame_periods
    found = reproject(scene)
    baselines = camera_baselines(scene, found.depth_of_frame)
    coverage = period_coverage(scene.points.xyz, seen > 0)
    observed_in = periods[scene.points.track_frame]
    by_period = tuple(
        Measures(
            points_seen=int(np.count_nonzero(seen[:, p])),
            observations=int(seen[:, p].sum()),
            track_mean=_mean(_positive(seen[:, p])),
            track_median=_median(_positive(seen[:, p])),
            reprojection_error=_mean(found.residual[observed_in == p]),
            baseline=_median(baselines[periods == p]),
            coverage=coverage[p],
        )
        for p in range(scene.num_periods)
    )
    length = _positive(seen.sum(axis=1))
    whole = Measures(
        points_seen=len(length),
        observations=int(seen.sum()),
        track_mean=_mean(length),
        track_median=_median(length),
        reprojection_error=_mean(found.residual),
        baseline=_median(baselines),
        coverage=None if not len(length) else 1.0,
    )
    return SceneStatistics(
        counts=count_scene(scene, count=count),
        periods=by_period,
        whole=whole,
        overlap=period_overlap(seen > 0),
        in_view=in_view(scene, seen > 0, found.depth),
        unit=scene.world.unit,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Reprojection:
    """Where the points of a scene lie for the cameras that see them."""

    residual: Array
    """Of each observation in pixels; NaN where the point is not in front of the camera or not
    finite. [M]"""
    depth: Array
    """Of the point of each observation, in world units; NaN where it is not in front. [M]"""
    depth_of_frame: Array
    """Median depth of what each frame sees in front of it; NaN where it sees nothing. [frames]"""


def reproject(scene: Scene) -> Reprojection:
    """Project every observed point, distortion included."""
    points = scene.points
    views = [(f.camera, f.cam_from_world) for f in scene.frames]
    offset, depth = tracks.reproject(
        views, points.xyz, points.track_start, points.track_frame, points.track_xy
    )
    seen = (depth.take(rows) for rows in tracks.by_image(points.track_frame, len(views)))
    return Reprojection(
        residual=np.hypot(offset[:, 0], offset[:, 1]),
        depth=depth,
        depth_of_frame=np.array([_median_depth(d[~np.isnan(d)]) for d in seen]),
    )


def _median_depth(depth: Array) -> float:
    return float(np.median(depth)) if len(depth) else np.nan


def camera_baselines(scene: Scene, depths: Array) -> Array:
    """Distance to the nearest camera of the same period over the median depth of what is seen.

    Args:
        scene: The scene.
        depths: Median depth of what each frame sees. [frames]

    Returns:
        NaN for cameras without points, and for one that is alone in its period. [frames]
    """
    centres = camera_centre(np.stack([f.cam_from_world for f in scene.frames]))
    periods = scene.frame_periods
    nearest = np.full(len(centres), np.nan)
    for p in range(scene.num_periods):
        mine = np.flatnonzero(periods == p)
        nearest[mine] = _nearest_distance(centres[mine])
    return nearest / depths


def _nearest_distance(centres: Array, rows: int = 512) -> Array:
    """Distance of each place to the nearest other one; NaN if there is none. [n, 3] -> [n]"""
    nearest = np.full(len(centres), np.nan)
    if len(centres) < 2:
        return nearest
    for begin in range(0, len(centres), rows):  # a few rows at a time: n may be thousands
        block = slice(begin, begin + rows)
        distance = np.linalg.norm(centres[block, None] - centres, axis=2)
        within = np.arange(len(distance))
        distance[within, begin + within] = np.inf
        nearest[block] = distance.min(axis=1)
    return nearest


def period_overlap(seen: NDArray[np.bool_]) -> tuple[tuple[float | None, ...], ...]:
    """Share of the points of each period that each other sees, too. [P, T] -> [T, T]"""
    columns = seen.astype(np.float32)  # exact up to 16 million points
    both = (columns.T @ columns).astype(np.float64)
    rows = []
    for p, own in enumerate(np.diag(both)):
        rows.append(tuple(float(n / own) if own else None for n in both[p]))
    return tuple(rows)


def period_coverage(xyz: Array, seen: NDArray[np.bool_]) -> list[float | None]:
    """Coverage of each period; see `Measures.coverage`. [P, 3], [P, T] -> T values"""
    used = seen.any(axis=1) & np.isfinite(xyz).all(axis=1)
    if not used.any():
        return [None] * seen.shape[1]
    xyz, seen = xyz[used], seen[used]
    low, high = robust_range(xyz)
    inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
    if not inside.any():
        low, high, inside = xyz.min(axis=0), xyz.max(axis=0), np.ones(len(xyz), bool)
    edge = float((high - low).max()) / CELLS or 1.0
    cell = ((xyz[inside] - low) / edge).astype(np.int64)
    flat = (cell[:, 0] * (CELLS + 1) + cell[:, 1]) * (CELLS + 1) + cell[:, 2]
    total = int(np.count_nonzero(np.bincount(flat)))
    covered = [int(np.count_nonzero(np.bincount(flat[column]))) for column in seen[inside].T]
    return [n / total for n in covered]


def _positive(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    return counts[counts > 0]


def _mean(values: NDArray[np.float64] | NDArray[np.int64]) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def _median(values: NDArray[np.float64] | NDArray[np.int64]) -> float | None:
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


# How far a scene extends

CORE = (10.0, 90.0)
"""Percentiles between which the middle of a scene lies, even with many outliers on every side."""
REACH = 0.8
"""Of the longest edge of the core, on every side: farther points are outliers. One reach for
all axes: the towers of a flat place are not outliers."""
ENDS = (2.0, 98.0)
"""Percentiles of what is left that are the ends of the scene, and `BEYOND` that."""
BEYOND = 0.08
"""Of the distance between the two ends: an even spread of points is inside as a whole."""
MAX_SAMPLE = 50_000
"""Points that are looked at: an even choice of a larger cloud is enough."""


def robust_range(xyz: Array) -> Array:
    """Extent of a cloud along each axis without outliers.

    Up to a tenth of all points on every side may be outliers.

    Args:
        xyz: Finite places, at least one. [n, 3]

    Returns:
        The lowest and the highest coordinates; points beyond are outliers. [2, 3]
    """
    xyz = xyz[:: -(-len(xyz) // MAX_SAMPLE)]
    low, high = np.percentile(xyz, CORE, axis=0)
    reach = REACH * (high - low).max()
    near = xyz[((xyz >= low - reach) & (xyz <= high + reach)).all(axis=1)]
    if 2 * len(near) < len(xyz):  # few points, or clusters: there is no middle
        near = xyz
    low, high = np.percentile(near, ENDS, axis=0)
    beyond = BEYOND * (high - low)
    return np.stack(
        [np.maximum(low - beyond, near.min(axis=0)), np.minimum(high + beyond, near.max(axis=0))]
    )
