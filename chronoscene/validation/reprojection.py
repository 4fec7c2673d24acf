"""Where points project to in the images that see them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.geometry import rotation_from_quaternion
from chronoscene.scene import Camera
from chronoscene.validation.observations import Observations
from chronoscene.validation.raw_model import RawImages, RawPoints


class Reprojection(NamedTuple):
    """Of one image, over its m finite observations."""

    image: int
    """Index into the images."""
    rows: NDArray[np.int64]
    """Indices into the observations. [m]"""
    depth: NDArray[np.float64]
    """World units along the optical axis. [m]"""
    error: NDArray[np.float64]
    """Distance in pixels between projection and observation. [m]"""


def good_poses(images: RawImages) -> NDArray[np.bool_]:
    """Which poses are finite with a quaternion that is not zero. [I]"""
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(images.quaternions, axis=1)
    return np.isfinite(norm) & (norm > 0) & np.isfinite(images.translations).all(axis=1)


def reproject(
    cameras: Mapping[int, Camera], images: RawImages, points: RawPoints, seen: Observations
) -> Iterator[Reprojection]:
    """Project the points of every image that has a good pose, a camera and observations.

    Distortion is not applied: errors mean something for pinhole cameras only.
    """
    good = good_poses(images)
    finite = np.asarray(np.isfinite(points.xyz).all(axis=1))[seen.point]
    for image, rows in seen.by_image(images):
        camera = cameras.get(int(images.camera_ids[image]))
        if camera is None or not good[image]:
            continue
        rows = rows[finite[rows]]
        target = images.keypoint_xy[seen.keypoint[rows]]
        with np.errstate(all="ignore"):  # infinite for absurd poses
            depth, projected = project(images, image, camera.K, points.xyz[seen.point[rows]])
            error = np.linalg.norm(projected - target, axis=1)
        known = np.isfinite(target).all(axis=1)
        yield Reprojection(image, rows[known], depth[known], error[known])


def project(
    images: RawImages, image: int, K: NDArray[np.float64], xyz: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Depth [m] and pixel position [m, 2] of points."""
    rotation = rotation_from_quaternion(images.quaternions[image])
    local = xyz @ rotation.T + images.translations[image]
    depth = local[:, 2]
    return depth, local[:, :2] / depth[:, None] * K[[0, 1], [0, 1]] + K[:2, 2]
