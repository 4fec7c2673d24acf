"""Reprojection errors of images and periods, depths of points, and periods in a frame of their own:
mirrored, scaled or moved against the others.

The points that such a period shares with the others do not fit its poses. Two explanations are
tried: negated axes of world and camera, and a similarity to the same points as triangulated by the
cameras of the period alone.
"""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.scene.cameras import unproject_pixels
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.scene.similarity import Similarity, fit_robustly
from chronoscene.scene.tracks import MIN_PARALLAX, intersect_rays
from chronoscene.validation.folder.grouping import grouped
from chronoscene.validation.folder.scene_folder import RawScene, derived

MIN_OBSERVATIONS = 10  # Observations of an image from which the median of its errors is meaningful

MAX_ERROR_SHARE, MIN_LIMIT = 0.01, 4.0
"""Median reprojection error of an image, as a share of its diagonal and in pixels, beyond which its
pose does not fit. COLMAP itself drops observations beyond 4 pixels."""

MAX_DEPTHS = 500  # Depths sampled from an image: enough for a percentile over a period
MIN_IMAGES = 3  # Images with an error from which the median of a period is meaningful

MAX_RAYS = 20_000  # Observations sampled from a period
MIN_POINTS = 10  # Points that the cameras of a period must triangulate alone

STRAY = 100.0
"""Distance of a camera from the others, in units of their median distance, beyond which its rays
would distort all points."""

FITS = 0.02  # Median distance after the similarity, as a share of the extent of the points
BETTER = 1 / 3  # Share of the median distance before the similarity that may be left after it

WELL = 0.5
"""Share of the limit, and of the error that a similarity leaves, that may remain if a factor of the
focal length explains everything: to cameras that see one place from one distance, a wrong scale
looks nearly like a wrong focal length."""

SAME_FOCAL = 0.002  # Relative difference of focal lengths too small to explain anything

AXES = "xyz"

WORSE = 3.0
"""Ratio of median reprojection errors, of a period to the best one or of an image to its period,
beyond which it stands out."""

MIN_ERROR = 1.0  # Pixels; smaller errors are fine whatever their ratio to the rest

MAX_WRONG = 0.5
"""Share of the images of a period with a pose that does not fit, beyond which the period is at
fault."""


@derived
def image_errors(scene: RawScene) -> NDArray[np.float64]:
    """Median reprojection error of each image in pixels, of the points in front of it. [I]

    NaN for images with fewer than `MIN_OBSERVATIONS` points. Points that a camera cannot see
    because of its distortion count as infinitely wrong.
    """
    errors = np.full(len(scene.images or ()), np.nan)
    for seen in scene.reprojections or ():
        front = seen.error[seen.depth > 0]
        if len(front) >= MIN_OBSERVATIONS:
            errors[seen.image] = np.median(np.where(np.isnan(front), np.inf, front))
    return errors


def judged_images(scene: RawScene) -> list[int]:
    """Indices of the images with a reprojection error."""
    return list(np.flatnonzero(~np.isnan(image_errors(scene))).tolist())


def pose_limit(scene: RawScene, image: int) -> float:
    """Reprojection error in pixels beyond which the pose of an image does not fit."""
    assert scene.images is not None
    camera = scene.usable_cameras[int(scene.images.camera_ids[image])]
    return max(MIN_LIMIT, MAX_ERROR_SHARE * float(np.hypot(camera.width, camera.height)))


@derived
def period_errors(scene: RawScene) -> dict[int, float]:
    """Median over the images of a period of `image_errors`, for periods with enough of them."""
    judged = ~np.isnan(image_errors(scene))
    errors = {
        period: image_errors(scene)[judged & (scene.image_periods == index)]
        for index, period in enumerate(scene.period_ids)
    }
    return {p: float(np.median(e)) for p, e in errors.items() if len(e) >= MIN_IMAGES}


@derived
def _depths(scene: RawScene) -> dict[int, NDArray[np.float64]]:
    """Samples of the depths in front of the cameras by index of the period, -1 for none."""
    samples = (
        (int(scene.image_periods[seen.image]), seen.depth[:: len(seen.depth) // MAX_DEPTHS + 1])
        for seen in scene.reprojections or ()
    )
    front = ((period, depth[(depth > 0) & np.isfinite(depth)]) for period, depth in samples)
    by_period = grouped((period, depth) for period, depth in front if len(depth))
    return {period: np.concatenate(depths) for period, depths in by_period.items()}


def depth_percentiles(scene: RawScene, percent: float) -> dict[int, float]:
    """Percentile of the depths by index of the period, of the periods that have any."""
    return {period: float(np.percentile(d, percent)) for period, d in _depths(scene).items()}


def typical_depth(scene: RawScene) -> float:
    """Median distance of the points from the cameras that see them; 0 if unknown."""
    every = np.concatenate([np.zeros(0), *_depths(scene).values()])
    return float(np.median(every)) if len(every) else 0.0


def outlier_limit(usual: float) -> float:
    """Median reprojection error in pixels that stands out from a usual one."""
    return max(MIN_ERROR, WORSE * usual)


def period_limit(scene: RawScene) -> float:
    """Median reprojection error in pixels beyond which a period stands out among the others."""
    return outlier_limit(min(period_errors(scene).values(), default=0.0))


@derived
def own_frames(scene: RawScene) -> dict[int, str]:
    """Periods in a frame of their own by index, and what brings them into that of the others."""
    if scene.point_periods is None:
        return {}
    judged = ~np.isnan(image_errors(scene)) | _behind(scene)
    limits = {
        i: _limit_of_wrong(scene, np.flatnonzero(judged & (scene.image_periods == i)))
        for i in range(len(scene.period_ids))
    }
    if all(limit is not None for limit in limits.values()):
        return {}  # no period is right: there is no frame to compare with
    found = {i: explain(scene, i, limit) for i, limit in limits.items() if limit is not None}
    return {i: words for i, words in found.items() if words is not None}


def _limit_of_wrong(scene: RawScene, mine: NDArray[np.int64]) -> float | None:
    """Error in pixels that most of some images of a period exceed, or None; ``mine``: indices."""
    if not len(mine):
        return None
    usual = period_limit(scene) if len(period_errors(scene)) > 1 else np.inf
    limit = min(usual, float(np.median([pose_limit(scene, i) for i in mine.tolist()])))
    wrong = np.count_nonzero(~(image_errors(scene)[mine] <= limit))
    return limit if wrong > MAX_WRONG * len(mine) else None


def _behind(scene: RawScene) -> NDArray[np.bool_]:
    """Whether most points of an image are behind it. [I]"""
    behind = np.zeros(len(scene.images or ()), bool)
    for seen in scene.reprojections or ():
        wrong = np.count_nonzero(~(seen.depth > 0))
        behind[seen.image] = wrong > MAX_WRONG * len(seen.depth)
    return behind


class Rays:
    """Observations of points by the images of one period (M observations)."""

    def __init__(self, scene: RawScene, period: int) -> None:
        """Take the observations with a usable camera and a valid pose; ``period``: its index."""
        images, points, seen = scene.images, scene.points, scene.observations
        table = scene.point_periods
        assert images is not None and points is not None
        assert seen is not None and table is not None
        of_period = [r for r in scene.reprojections or () if scene.image_periods[r.image] == period]
        share = table.sum(axis=1) > 1
        if not (share & table[:, period]).any():
            share = table[:, period]  # it may at least agree with its own points
        rows = np.concatenate([np.zeros(0, np.int64), *(r.rows for r in of_period)])
        rows = rows[share[seen.point[rows]]]
        # Sample whole tracks, so that points keep several rays.
        step = len(rows) // MAX_RAYS + 1
        rows = rows[seen.point[rows] % step == 0]
        self.image, self.point = seen.image[rows], seen.point[rows]
        self.xyz = points.xyz[self.point]
        self.rotation = rotation_from_quaternion(images.quaternions)[self.image]
        self.translation = images.translations[self.image]
        self.centre = scene.centres[self.image]
        self.focal = np.ones((len(rows), 2))
        """Pixels. [M, 2]"""
        self.plane = images.keypoint_xy[seen.keypoint[rows]]
        """Observations on the plane one unit in front of the camera. [M, 2]"""
        camera_ids = images.camera_ids[self.image]
        for camera_id in np.unique(camera_ids).tolist():
            camera, mine = scene.usable_cameras[camera_id], camera_ids == camera_id
            self.focal[mine] = camera.K[[0, 1], [0, 1]]
            self.plane[mine] = unproject_pixels(camera, self.plane[mine])

    def error(self, world: Array, camera: Array) -> float:
        """Median error in pixels, without distortion, with signs of world and camera axes."""
        local = np.einsum("nij,nj->ni", self.rotation, self.xyz * world) + self.translation
        local = local * camera
        distance = self._distances(local)
        distance[~(local[:, 2] > 0)] = np.inf
        return float(np.median(distance)) if len(distance) else np.inf

    def error_in(self, similarity: Similarity) -> float:
        """Median error in pixels with the points in the source frame of a similarity."""
        own = np.linalg.solve(similarity.matrix, (self.xyz - similarity.translation).T).T
        local = np.einsum("nij,nj->ni", self.rotation, own) + self.translation
        return float(np.median(self._distances(local)))

    def _distances(self, local: Array) -> Array:
        """Pixels, without distortion, between points in camera frames and their observations.

        Infinite where undefined. [M, 3] -> [M]
        """
        shift = (local[:, :2] / local[:, 2:] - self.plane) * self.focal
        distance = np.linalg.norm(shift, axis=1)
        return np.where(np.isnan(distance), np.inf, distance)

    def focal_factor(self) -> tuple[float, float]:
        """Best factor of the focal lengths, and the median error in pixels with it."""
        local = np.einsum("nij,nj->ni", self.rotation, self.xyz) + self.translation
        projected, observed = local[:, :2] / local[:, 2:] * self.focal, self.plane * self.focal
        known = (local[:, 2] > 0) & np.isfinite(projected).all(axis=1)
        known &= np.isfinite(observed).all(axis=1)
        if not known.any():
            return 1.0, np.inf
        projected, observed = projected[known], observed[known]
        factor = float(np.median((projected * observed).sum(axis=1) / (projected**2).sum(axis=1)))
        return factor, float(np.median(np.linalg.norm(projected * factor - observed, axis=1)))

    def place_points(self) -> tuple[NDArray[np.int64], Array]:
        """Triangulate the points with enough parallax from these rays alone: indices, positions."""
        local = np.column_stack([self.plane, np.ones(len(self.plane))])
        direction = np.einsum("nji,nj->ni", self.rotation, local)
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        away = np.linalg.norm(self.centre - np.median(self.centre, axis=0), axis=1)
        sound = np.isfinite(direction).all(axis=1) & (away <= STRAY * np.median(away))
        rows = np.flatnonzero(sound)
        if not len(rows):
            return rows, np.zeros((0, 3))
        rows = rows[np.argsort(self.point[rows], kind="stable")]
        index, first = np.unique(self.point[rows], return_index=True)
        xyz, parallax = intersect_rays(direction[rows], self.centre[rows], first)
        good = parallax > MIN_PARALLAX
        return index[good], xyz[good]


def explain(scene: RawScene, period: int, limit: float) -> str | None:
    """Description of what transforms a period that disagrees with the others into their frame.

    A right explanation leaves a reprojection error of up to ``limit`` pixels.
    """
    rays = Rays(scene, period)
    if len(rays.point) < MIN_POINTS:
        return None
    signs = [np.array(s, np.float64) for s in product((1, -1), repeat=3)]
    errors = {(i, j): rays.error(a, b) for i, a in enumerate(signs) for j, b in enumerate(signs)}
    world, camera = min(errors, key=lambda key: errors[key])
    if errors[world, camera] <= limit:
        negated = min(*signs[world], *signs[camera]) < 0
        return _negated(signs[world], signs[camera]) if negated else None
    assert scene.points is not None
    index, own = rays.place_points()
    target = scene.points.xyz[index]
    found = fit_robustly(own, target, mirror=True) if len(index) >= MIN_POINTS else None
    if found is None:
        return None
    similarity, left = found[0], np.median(found[1])
    extent = np.median(np.linalg.norm(target - np.median(target, axis=0), axis=1))
    before = np.median(np.linalg.norm(own - target, axis=1))
    if not (left <= FITS * extent and left <= BETTER * before):
        return None
    _, focal_error = rays.focal_factor()
    if focal_error <= WELL * min(limit, rays.error_in(similarity)):
        return None  # the camera is wrong, not the frame
    return _moved(similarity, own, target)


def focal_factor(rays: Rays, limit: float) -> float | None:
    """Factor of the focal lengths that alone explains a period, if there is one."""
    if len(rays.point) < MIN_POINTS:
        return None
    factor, error = rays.focal_factor()
    return factor if error <= WELL * limit and abs(factor - 1) > SAME_FOCAL else None


def _negated(world: Array, camera: Array) -> str:
    parts = []
    for what, signs in (("world", world), ("camera", camera)):
        if (signs < 0).any():
            axes = " and ".join(AXES[i] for i in np.flatnonzero(signs < 0))
            parts.append(f"{axes} of the {what} negated")
    mirrored = " mirrored," if np.prod(world) < 0 else ""
    return f"a period that fits{mirrored} with {', '.join(parts)}"


def _moved(similarity: Similarity, own: Array, target: Array) -> str:
    rotation = similarity.matrix / similarity.scale
    turn = rotation if not similarity.mirrored else -rotation
    cosine = np.clip((np.trace(turn) - 1) / 2, -1, 1)
    angle = round(float(np.degrees(np.arccos(cosine))), 4)  # arccos is that exact near 0
    shift = np.linalg.norm(np.median(target, axis=0) - np.median(own, axis=0))
    mirrored = "mirrored, " if similarity.mirrored else ""
    return (
        f"a period in a frame of its own: it fits {mirrored}scaled by {similarity.scale:.4g}, "
        f"rotated by {angle:.3g} degrees and moved by {shift:.3g}"
    )
