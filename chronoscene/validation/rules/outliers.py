"""CS515 to CS518: what stands out among periods, images and points."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from chronoscene.io.wording import counted, shown
from chronoscene.validation.checks.period_frames import (
    LEAST_ERROR,
    WORSE,
    Rays,
    focal_factor,
    own_frames,
    period_limit,
)
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

MOST_STORED = 0.9
"""Share of the points that must have an error stored with them."""

MOST_DUPLICATES = 0.05
"""Share of points on top of another one. COLMAP's models were seen with one percent."""

SAME_POINT = 1e-6
"""Edge of the cells in which points are one, in median distances of the points from their middle:
copies that went through single precision differ by a tenth of that."""

SAMPLE = 10_000
"""Points from which that distance is taken."""

FAR = 100.0
"""Distance of a point from the middle, in units of the median distance of points and cameras."""


@rule(
    "CS515",
    "period-error",
    "warning",
    what="The reprojection error of a period is far above that of another one.",
    remedy="register the period again: refine its poses and its camera, or match more images",
    bad="medians of 0.5 px in period 0 and 3.1 px in period 1",
    needs=("images", "periods", "reprojections"),
)
def period_error(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    for period, limit in _worse_periods(scene).items():
        mine = np.flatnonzero(scene.image_periods == scene.period_ids.index(period))
        known = mine[~np.isnan(scene.image_errors[mine])]
        worst = known[np.argsort(-scene.image_errors[known])]
        named = shown([scene.images.names[i] for i in worst])
        found = f"{scene.period_errors[period]:.3g} px; worst are {named}"
        found += _other_focal(scene, scene.period_ids.index(period), limit)
        yield Hit(f"period {period}", f"a median error below {limit:.3g} px", found)


def _worse_periods(scene: RawScene) -> dict[int, float]:
    """Periods that stand out, with what their median error should be below in pixels."""
    limit = period_limit(scene)
    judged = np.flatnonzero(~np.isnan(scene.image_errors)).tolist()
    if not judged or limit > WORSE * np.median([scene.pose_limit(i) for i in judged]):
        return {}  # no period fits: nothing to compare with
    explained = {scene.period_ids[index] for index in scene.derived(own_frames)}
    worse = (period for period, median in scene.period_errors.items() if median > limit)
    return {period: limit for period in worse if period not in explained}


def _other_focal(scene: RawScene, index: int, limit: float) -> str:
    """In words, that other focal lengths explain the errors of a period, if they do."""
    if scene.point_periods is None:
        return ""
    factor = focal_factor(Rays(scene, index), limit)
    return "" if factor is None else f"; it fits with focal lengths times {factor:.4g}"


@rule(
    "CS524",
    "error-outdated",
    "warning",
    what="Points are reprojected far worse than the errors stored with them say: cameras, poses or "
    "points were changed after the model was made.",
    remedy="use cameras, images and points of one model; or refine them together (colmap "
    "bundle_adjuster)",
    bad="a focal length replaced by that of the data sheet; stored 0.5 px, found 3.2 px",
    needs=("points", "reprojections"),
)
def error_outdated(scene: RawScene) -> Iterator[Hit]:
    assert scene.points is not None
    stored = scene.points.error[(scene.points.error > 0) & np.isfinite(scene.points.error)]
    if len(stored) < MOST_STORED * len(scene.points) or not len(stored):
        return  # not every program writes them
    judged = np.flatnonzero(~np.isnan(scene.image_errors)).tolist()
    if not judged:
        return
    found, expected = float(np.median(scene.image_errors[judged])), float(np.median(stored))
    fits = all(scene.image_errors[i] <= scene.pose_limit(i) for i in judged)
    if fits and found > max(LEAST_ERROR, WORSE * expected) and not _worse_periods(scene):
        text = f"{found:.3g} px (median)"
        yield Hit(scene.model_file("points3D"), f"errors about {expected:.3g} px", text)


@rule(
    "CS516",
    "image-error",
    "warning",
    what="The reprojection error of an image is far above that of its period.",
    remedy="check pose and camera of this image, or register it again",
    bad="3.1 px in one image, 0.5 px in the others",
    needs=("images", "periods", "reprojections"),
)
def image_error(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    medians = scene.period_errors
    for image in np.flatnonzero(~np.isnan(scene.image_errors)).tolist():
        index, error = int(scene.image_periods[image]), float(scene.image_errors[image])
        period = scene.period_ids[index] if index >= 0 else -1
        limit = max(LEAST_ERROR, WORSE * medians.get(period, np.inf))
        if limit < error <= scene.pose_limit(image):  # beyond, it is another rule's
            place = scene.image_place(scene.images.names[image])
            yield Hit(place, f"a median error below {limit:.3g} px", f"{error:.3g} px")


@rule(
    "CS517",
    "duplicate-points",
    "warning",
    what=f"More than {MOST_DUPLICATES:.0%} of the points lie on another point, to a millionth of "
    "the scene.",
    remedy="merge points that are one (colmap point_triangulator on a model without points)",
    bad="the points of two runs in one file",
    needs=("points",),
)
def duplicate_points(scene: RawScene) -> Iterator[Hit]:
    points = scene.points
    assert points is not None
    finite = np.isfinite(points.xyz).all(axis=1)
    xyz = _cells(points.xyz[finite])
    if _repeated(_mix(xyz)) <= MOST_DUPLICATES * len(xyz):
        return  # sorting one number for each point is much quicker than sorting points
    twice = len(xyz) - len(np.unique(xyz, axis=0))
    if twice > MOST_DUPLICATES * len(xyz):
        found = f"{twice} of {len(xyz)} on another one"
        yield Hit(scene.model_file("points3D"), "points apart from each other", found, count=twice)


def _cells(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """The small cubes that points are in, as whole numbers; the points where they are all one."""
    sample = xyz[:: len(xyz) // SAMPLE + 1]
    if not len(sample):
        return xyz
    edge = SAME_POINT * float(np.median(np.abs(sample - np.median(sample, axis=0)).max(axis=1)))
    cells = np.floor(xyz / edge) if 0 < edge < np.inf else xyz
    return np.asarray(cells + 0.0)  # makes -0.0 positive, so that equal numbers have equal bits


def _mix(xyz: NDArray[np.float64]) -> NDArray[np.uint64]:
    """A number for each point: the same for equal points, hardly ever for different ones."""
    mixed = np.zeros(len(xyz), np.uint64)
    for bits in np.ascontiguousarray(xyz.T).view(np.uint64):
        mixed = (mixed ^ bits ^ (bits >> np.uint64(32))) * np.uint64(0x9E3779B97F4A7C15)
        mixed ^= mixed >> np.uint64(29)
    return mixed


def _repeated(values: NDArray[np.uint64]) -> int:
    """How many values come after an equal one."""
    ordered = np.sort(values)
    return int(np.count_nonzero(ordered[1:] == ordered[:-1]))


@rule(
    "CS518",
    "far-points",
    "warning",
    what="Points are absurdly far from everything else; they stretch every box around the scene.",
    remedy="filter the points: they come from wrong matches, or from the sky",
    bad="a point 40 km from a square of 100 m",
    needs=("images", "points"),
)
def far_points(scene: RawScene) -> Iterator[Hit]:
    points = scene.points
    assert points is not None
    xyz, cameras = points.xyz, scene.centres[~np.isnan(scene.centres).any(axis=1)]
    usable = np.isfinite(xyz).all(axis=1)
    if not usable.any():
        return
    middle = np.median(xyz[usable], axis=0)
    distance = np.linalg.norm(xyz - middle, axis=1)
    typical = np.median(distance[usable])
    if len(cameras):
        typical = max(typical, np.median(np.linalg.norm(cameras - middle, axis=1)))
    far = usable & (distance > FAR * typical)
    if number := int(np.count_nonzero(far)):
        ids = ", ".join(map(str, points.ids[far][:3])) + (" ..." if number > 3 else "")
        found = f"{counted(number, 'point')} up to {distance[far].max():.3g} away (ids {ids})"
        expected = f"points within {FAR * typical:.3g} of the middle"
        yield Hit(scene.model_file("points3D"), expected, found, count=number)
