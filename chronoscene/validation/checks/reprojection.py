"""Reprojection errors of images and periods, and depths of the points that they see."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.validation.scene_folder import RawScene, derived

MIN_OBSERVATIONS = 10
"""Observations of an image from which the median of its errors is meaningful."""

MAX_ERROR_SHARE, MIN_LIMIT = 0.01, 4.0
"""Median reprojection error of an image, as a share of its diagonal and in pixels, beyond which its
pose does not fit. COLMAP itself drops observations beyond 4 pixels."""

MAX_DEPTHS = 500
"""Depths sampled from an image: enough for a percentile over a period."""

MIN_IMAGES = 3
"""Images with an error from which the median of a period is meaningful."""


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
    medians = {}
    for index, period in enumerate(scene.period_ids):
        errors = image_errors(scene)[scene.image_periods == index]
        errors = errors[~np.isnan(errors)]
        if len(errors) >= MIN_IMAGES:
            medians[period] = float(np.median(errors))
    return medians


@derived
def _depths(scene: RawScene) -> dict[int, NDArray[np.float64]]:
    """Samples of the depths in front of the cameras by index of the period, -1 for none."""
    by_period: dict[int, list[NDArray[np.float64]]] = {}
    for seen in scene.reprojections or ():
        depth = seen.depth[:: len(seen.depth) // MAX_DEPTHS + 1]
        front = depth[(depth > 0) & np.isfinite(depth)]
        if len(front):
            by_period.setdefault(int(scene.image_periods[seen.image]), []).append(front)
    return {period: np.concatenate(depths) for period, depths in by_period.items()}


def depth_percentiles(scene: RawScene, percent: float) -> dict[int, float]:
    """Percentile of the depths by index of the period, of the periods that have any."""
    return {period: float(np.percentile(d, percent)) for period, d in _depths(scene).items()}


def typical_depth(scene: RawScene) -> float:
    """Median distance of the points from the cameras that see them; 0 if unknown."""
    every = np.concatenate([np.zeros(0), *_depths(scene).values()])
    return float(np.median(every)) if len(every) else 0.0
