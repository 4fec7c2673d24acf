"""Where points project to in the images that see them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.arrays import RawImages, RawPoints
from chronoscene.scene.cameras import Camera, project_points
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation.checks.observations import Observations

Array = NDArray[np.float64]


class Reprojection(NamedTuple):
    """Of one image, over its m finite observations."""

    image: int
    """Index into the images."""
    rows: NDArray[np.int64]
    """Indices into the observations. [m]"""
    depth: NDArray[np.float64]
    """World units along the optical axis. [m]"""
    error: NDArray[np.float64]
    """Distance in pixels between projection and observation; NaN behind the camera. [m]"""
    outside: int
    """Observations that are not within the image."""


def good_poses(images: RawImages) -> NDArray[np.bool_]:
    """Which poses are finite with a quaternion that is not zero. [I]"""
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(images.quaternions, axis=1)
    return np.isfinite(norm) & (norm > 0) & np.isfinite(images.translations).all(axis=1)


def reproject(
    cameras: Mapping[int, Camera], images: RawImages, points: RawPoints, seen: Observations
) -> Iterator[Reprojection]:
    """Project the points of every image that has a good pose, a camera and observations."""
    good = good_poses(images)
    with np.errstate(all="ignore"):
        rotations = rotation_from_quaternion(images.quaternions)
    # Columns by themselves: numpy is several times slower along a short last axis. And `take` is
    # three times quicker than brackets.
    xyz = np.ascontiguousarray(points.xyz.T)
    uv = np.ascontiguousarray(images.keypoint_xy.T)
    for image, rows in seen.by_image(images):
        camera = cameras.get(int(images.camera_ids[image]))
        if camera is None or not good[image]:
            continue
        place = xyz.take(seen.point.take(rows), axis=1)
        u, v = uv.take(seen.keypoint.take(rows), axis=1)
        with np.errstate(all="ignore"):  # infinite for absurd poses
            depth, x, y = project(rotations[image], images.translations[image], camera, *place)
            error = np.sqrt((x - u) ** 2 + (y - v) ** 2)
        # What is not finite in points and keypoints has rules of its own.
        known = np.isfinite(place).all(axis=0) & np.isfinite(u) & np.isfinite(v)
        inside = (u >= 0) & (u <= camera.width) & (v >= 0) & (v <= camera.height)
        outside = int(np.count_nonzero(known & ~inside))
        if not known.all():
            rows, depth, error = rows[known], depth[known], error[known]
        yield Reprojection(image, rows, depth, error, outside)


def project(
    rotation: Array, translation: Array, camera: Camera, x: Array, y: Array, z: Array
) -> tuple[Array, Array, Array]:
    """Depth, and pixel position along x and y, of points at ``x, y, z`` in the world. [m] each

    Behind the camera, positions are NaN.
    """
    local = np.empty((3, len(x)))
    for i, (row, shift) in enumerate(zip(rotation.tolist(), translation.tolist(), strict=True)):
        local[i] = row[0] * x + row[1] * y + row[2] * z + shift
    return local[2], *project_points(camera, local.T).T
