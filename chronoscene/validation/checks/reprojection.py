"""Reprojection errors of images and periods, and depths of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.validation.folder.scene_folder import RawScene, derived

MIN_OBSERVATIONS = 10  # Observations of an image from which the median of its errors is meaningful

MAX_ERROR_SHARE, MIN_LIMIT = 0.01, 4.0
"""Median reprojection error of an image, as a share of its diagonal and in pixels, beyond which its
pose does not fit. COLMAP itself drops observations beyond 4 pixels."""

MAX_DEPTHS = 500  # Depths sampled from an image: enough for a median over the scene
MIN_IMAGES = 3  # Images with an error from which the median of a period is meaningful

WORSE = 3.0
"""Ratio of median reprojection errors, of a period to the best one or of an image to its period,
beyond which it stands out."""

MIN_ERROR = 1.0  # Pixels; smaller errors are fine whatever their ratio to the rest


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
def typical_depth(scene: RawScene) -> float:
    """Median distance of the points from the cameras that see them; 0 if unknown."""
    samples = (s.depth[:: len(s.depth) // MAX_DEPTHS + 1] for s in scene.reprojections or ())
    depths = np.concatenate([np.zeros(0), *samples])
    front = depths[(depths > 0) & np.isfinite(depths)]
    return float(np.median(front)) if len(front) else 0.0


def outlier_limit(usual: float) -> float:
    """Median reprojection error in pixels that stands out from a usual one."""
    return max(MIN_ERROR, WORSE * usual)
