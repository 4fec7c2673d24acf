"""Standard deviations of poses and points, from the normal equations of an adjustment.

An observation has a standard deviation of one pixel, less weight where it fits badly (Cauchy), and
control that of its coordinates. Calibrations count as exact. COLMAP's own covariance of a point
takes the poses as exact, too, and so says little about the point. Worker process only.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from chronoscene.arrays import Array, Ints
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.models import image_pose

STEP = 1e-6  # Of the depth, over which projections are differentiated
RANK = 1e-10  # Share of the largest singular value of a point: below, its depth is open
LEAST = 1e-11  # Smallest eigenvalue of the scaled normal equations that counts as determined

Deviations = dict[str, tuple[list[float], list[float]]]


def standard_deviations(
    model: pycolmap.Reconstruction, control: Sequence[Mapping[str, Any]], ids: Mapping[str, int]
) -> tuple[Deviations, dict[str, list[float]]]:
    """Estimate how well poses and control points are known.

    Args:
        model: Adjusted.
        control: See `adjustment.adjust_with_control`.
        ids: Id of the point of each of them by name.

    Returns:
        By image, those of its centre in world units and of turns about the axes of the world in
        degrees; by control point, those of its place. Both are empty if not all is determined.
    """
    images = {int(i): k for k, i in enumerate(sorted(model.reg_image_ids()))}
    named = {point_id: k for k, point_id in enumerate(ids.values())}
    size = 6 * len(images) + 3 * len(named)
    normal = np.zeros((size, size))
    for point_id, point in model.points3D.items():
        ahead = [e for e in point.track.elements if _local(model, e.image_id, point.xyz)[2] > 0]
        if not ahead:
            continue
        parts = [_observation(model, e.image_id, e.point2D_idx, point.xyz) for e in ahead]
        columns = [6 * images[int(e.image_id)] + np.arange(6) for e in ahead]
        if point_id in named:
            own = 6 * len(images) + 3 * named[point_id] + np.arange(3)
            for (pose, place), column in zip(parts, columns, strict=True):
                both, where = np.hstack([pose, place]), np.concatenate([column, own])
                normal[np.ix_(where, where)] += both.T @ both
        else:
            _add_eliminated(normal, parts, columns)
    for point in control:
        if point["sigma"] is not None:
            own = 6 * len(images) + 3 * named[ids[point["name"]]] + np.arange(3)
            spread = np.array(point["sigma"])
            error = (model.points3D[ids[point["name"]]].xyz - point["xyz"]) / spread
            normal[own, own] += 1 / spread**2 / (1 + float(error @ error))
    scale = 1 / np.sqrt(np.maximum(np.diag(normal), 1e-300))
    scaled = normal * scale[:, None] * scale
    if np.linalg.eigvalsh(scaled)[0] < LEAST:
        return {}, {}
    found = np.sqrt(np.diag(np.linalg.inv(scaled))) * scale
    poses = found[: 6 * len(images)].reshape(-1, 2, 3)
    places = found[6 * len(images) :].reshape(-1, 3)
    return (
        {
            str(model.images[i].name): (poses[k, 0].tolist(), np.degrees(poses[k, 1]).tolist())
            for i, k in images.items()
        },
        {name: places[named[i]].tolist() for name, i in ids.items()},
    )


def _local(model: pycolmap.Reconstruction, image_id: int, xyz: Array) -> Array:
    """A point in the frame of a camera."""
    pose = image_pose(model.images[image_id])
    return np.asarray(pose[:3, :3] @ xyz + pose[:3, 3])


def _observation(
    model: pycolmap.Reconstruction, image_id: int, index: int, xyz: Array
) -> tuple[Array, Array]:
    """Weighted derivatives of a projection by centre and turn, and by the point. [2, 6], [2, 3]"""
    image = model.images[image_id]
    camera, pose = model.cameras[image.camera_id], image_pose(image)
    rotation, local = pose[:3, :3], _local(model, image_id, xyz)
    steps = STEP * local[2] * np.concatenate([np.eye(3), -np.eye(3), np.zeros((1, 3))])
    ends = np.array([camera.img_from_cam(local + step) for step in steps])
    by_local = ((ends[:3] - ends[3:6]) / (2 * STEP * local[2])).T
    error = image.points2D[index].xy - ends[6]
    by_local /= np.sqrt(1 + float(error @ error))
    by_place = by_local @ rotation
    x, y, z = rotation.T @ local
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.hstack([-by_place, by_place @ cross]), by_place


def _add_eliminated(
    normal: Array, parts: Sequence[tuple[Array, Array]], columns: Sequence[Ints]
) -> None:
    """Add the observations of a point that is itself of no interest: its Schur complement."""
    poses = np.zeros((2 * len(parts), 6 * len(parts)))
    for k, (pose, _) in enumerate(parts):
        poses[2 * k : 2 * k + 2, 6 * k : 6 * k + 6] = pose
    places = np.concatenate([place for _, place in parts])
    basis, values, _ = np.linalg.svd(places, full_matrices=False)
    basis = basis[:, values**2 > RANK * values[0] ** 2]
    left = poses - basis @ (basis.T @ poses)
    where = np.concatenate(columns)
    np.add.at(normal, np.ix_(where, where), left.T @ left)
