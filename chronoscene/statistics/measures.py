"""Tracks, reprojection error, overlap, views, baseline and coverage of the periods of a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.scene import Scene, tracks
from chronoscene.scene.geometry import camera_centre
from chronoscene.statistics.counts import CountRule, SceneCount, count_scene

CELLS = 50  # Cubes along the longest edge of a scene for its coverage


@dataclass(frozen=True, slots=True)
class Measures:
    """Measures of one period, or of a whole scene; None where there is nothing to measure."""

    points_seen: int
    """Points that images of the period see, however the points are counted."""
    observations: int
    """Observations of points by images of the period."""
    track_mean: float | None
    """Observations of a point by images of the period, mean over the points that any of them sees.
    An image may observe a point twice, which COLMAP counts twice as well."""
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
    view, whether b sees them or not; see `in_view`. [T, T]"""
    unit: str
    """Unit of the world: ``metre`` or ``unknown``."""


def measure_scene(scene: Scene, *, count: CountRule = "assigned") -> SceneStatistics:
    """Count and measure a scene; ``count`` is that of `count_scene`."""
    seen = scene.count_views()
    periods = scene.frame_periods
    any_view = seen > 0
    found = reproject(scene)
    baselines = camera_baselines(scene, found.depth_of_frame)
    coverage = period_coverage(scene.points.xyz, any_view)
    observed_in = periods[scene.points.track_frame]
    by_period = tuple(
        _measures(seen[:, p], found.residual[observed_in == p], baselines[periods == p], share)
        for p, share in enumerate(coverage)
    )
    length = seen.sum(axis=1)
    return SceneStatistics(
        counts=count_scene(scene, count=count, views=seen),
        periods=by_period,
        whole=_measures(length, found.residual, baselines, 1.0 if length.any() else None),
        overlap=period_overlap(any_view),
        in_view=in_view(scene, any_view, found.depth),
        unit=scene.world.unit,
    )


def _measures(views: Ints, residual: Array, baselines: Array, coverage: float | None) -> Measures:
    """Summarise some frames; ``views``: their observations of each point."""
    length = views[views > 0]
    return Measures(
        points_seen=len(length),
        observations=int(length.sum()),
        track_mean=_mean(length),
        track_median=median_of(length),
        reprojection_error=_mean(residual),
        baseline=median_of(baselines),
        coverage=coverage,
    )


class SceneReprojection(NamedTuple):
    """Positions of the points of a scene for the cameras that see them."""

    residual: Array
    """Error of each observation in pixels; NaN where the point is not in front of the camera or not
    finite. [M]"""
    depth: Array
    """Depth of the point of each observation, in world units; NaN if it is not in front. [M]"""
    depth_of_frame: Array
    """Median depth of what each frame sees in front of it; NaN where it sees nothing. [frames]"""


def reproject(scene: Scene) -> SceneReprojection:
    """Project every observed point, distortion included."""
    points = scene.points
    views = [(f.camera, f.cam_from_world) for f in scene.frames]
    residual, depth = np.full((2, len(points.track_frame)), np.nan)
    depth_of_frame = np.full(len(views), np.nan)
    projected = tracks.reproject(
        views, points.xyz, points.track_start, points.track_frame, points.track_xy
    )
    for frame, (rows, error, away) in enumerate(projected):
        residual[rows], depth[rows] = error, away
        ahead = away[~np.isnan(away)]
        if len(ahead):
            depth_of_frame[frame] = np.median(ahead)
    return SceneReprojection(residual, depth, depth_of_frame)


def camera_baselines(scene: Scene, depths: Array) -> Array:
    """Divide the distance to the nearest camera of the period by the median depth seen.

    Args:
        scene: The scene.
        depths: Median depth of the points that each frame sees. [frames]

    Returns:
        NaN for cameras without points, and for one that is alone in its period. [frames]
    """
    centres = camera_centre(scene.frame_poses)
    periods = scene.frame_periods
    nearest = np.full(len(centres), np.nan)
    for period in range(scene.num_periods):
        mine = np.flatnonzero(periods == period)
        for i in mine if len(mine) > 1 else ():
            distance = np.linalg.norm(centres[mine] - centres[i], axis=1)
            nearest[i] = distance[mine != i].min()
    return nearest / depths


def period_overlap(seen: Mask) -> tuple[tuple[float | None, ...], ...]:
    """Compute the share of the points of each period that each other sees. [P, T] -> [T, T]"""
    columns = seen.astype(np.float32)  # exact up to 16 million points
    both = (columns.T @ columns).astype(np.float64)
    return tuple(
        tuple(float(n / own) if own else None for n in row)
        for row, own in zip(both, np.diag(both), strict=True)
    )


def period_coverage(xyz: Array, seen: Mask) -> list[float | None]:
    """Compute the coverage of each period; see `Measures.coverage`. [P, 3], [P, T] -> T values"""
    used = seen.any(axis=1) & np.isfinite(xyz).all(axis=1)
    if not used.any():
        return [None] * seen.shape[1]
    xyz, seen = xyz[used], seen[used]
    low, high = robust_range(xyz)
    inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
    if not inside.any():
        low, high, inside = xyz.min(axis=0), xyz.max(axis=0), np.ones(len(xyz), bool)
    edge = float((high - low).max()) / CELLS or 1.0
    cell = np.minimum((xyz[inside] - low) / edge, CELLS - 1).astype(np.int64)
    flat = (cell[:, 0] * CELLS + cell[:, 1]) * CELLS + cell[:, 2]
    total = int(np.count_nonzero(np.bincount(flat)))
    covered = [int(np.count_nonzero(np.bincount(flat[column]))) for column in seen[inside].T]
    return [n / total for n in covered]


def in_view(scene: Scene, seen: Mask, depths: Array) -> tuple[tuple[float | None, ...], ...]:
    """Compute the share of the points of each period that the cameras of each have in view.

    A point is in view if it lies in front of a camera, inside of its image, and not much farther
    than what the camera's period sees. Whether something hides it is not known.

    Args:
        scene: The scene.
        seen: Points that images of a period see. [P, T]
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
    ahead = np.isfinite(depths)
    observed_in = scene.frame_periods[scene.points.track_frame]
    reach = np.full(periods, np.nan)  # depth up to which the images of each period see
    for period in range(periods) if ahead.any() else ():
        mine = depths[ahead & (observed_in == period)]
        sample = mine if len(mine) else depths[ahead]  # that of all if they see nothing
        reach[period] = REACH_FACTOR * np.percentile(sample, DEPTH_PERCENTILE)
    xyz = scene.points.xyz[np.concatenate(chosen)]
    shares = tracks.common_view(xyz, owner, views, reach)
    return tuple(tuple(None if np.isnan(x) else float(x) for x in row) for row in shares)


def _evenly(rows: Ints, count: int) -> Ints:
    """Choose at most ``count`` of them, evenly spread."""
    if len(rows) <= count:
        return rows
    return rows[np.linspace(0, len(rows) - 1, count).astype(np.int64)]


def _mean(values: Array | Ints) -> float | None:
    values = values[np.isfinite(values)]
    return float(values.mean()) if len(values) else None


def median_of(values: Array | Ints) -> float | None:
    """Compute the median of the finite values; None if there are none."""
    values = values[np.isfinite(values)]
    return float(np.median(values)) if len(values) else None


# Parts of a scene that are looked at

MAX_POINTS, MIN_POINTS_PER_PERIOD = 4000, 400
"""Points of all periods together that are looked for, and of each: a share is known to a percent or
two."""
DEPTH_PERCENTILE, REACH_FACTOR = 95.0, 1.5
"""Percentile of the depths at which the images of a period see points, and how many times as far
they could see some."""
CORE = (10.0, 90.0)
"""Percentiles between which the middle of a scene lies, even with many outliers on every side."""
REACH = 0.8
"""Share of the longest edge of the core, on every side: farther points are outliers. One reach for
all axes: the towers of a flat place are not outliers."""
ENDS, BEYOND = (2.0, 98.0), 0.08
"""Percentiles of what is left that are the ends of the scene, and what is added beyond each, as a
share of the distance between them: an even spread of points is inside as a whole."""
MAX_SAMPLE = 50_000  # Points that are looked at: an even choice of a larger cloud is enough


def robust_range(xyz: Array) -> Array:
    """Find the extent of a cloud along each axis without outliers.

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
