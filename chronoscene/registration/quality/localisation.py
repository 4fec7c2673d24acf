"""Symmetric check: images of one period are localised from points of the other alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array
from chronoscene.registration.quality.misalignment import (
    NOISE_FLOOR,
    generators,
    rotation_angle,
    transfer_variance,
)
from chronoscene.registration.quality.rays import Placed, Rays, project
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation
from chronoscene.scene.similarity import SIGMA

MIN_POINTS = 12  # Points of the other period that an image must see

MAX_POINTS = 400
MAX_IMAGES = 60

INLIER_PIXELS = 6.0


@dataclass(frozen=True, slots=True)
class Excess:
    """What noise does not explain of differences; 0 if it explains them all."""

    value: float
    low: float
    """Lower bound, from the spread over the images."""


@dataclass(frozen=True, slots=True)
class Localisation:
    """Difference between the poses of the model and those found from the other period."""

    images: int
    """Images that were localised."""
    tried: int
    """Images that see enough points of the other period."""
    rotation: float
    """Median, degrees."""
    centre: float
    """Median, world units."""
    rotation_excess: Excess
    """Degrees beyond the effect of the noise of the points."""
    centre_excess: Excess
    """World units."""


def localise(rays: Rays, placed: Placed) -> Localisation | str:
    """Compare the pose of each image by the points of the other period with its pose in the model.

    Args:
        rays: Observations by the images of the period that is localised.
        placed: Points by the images of the other period alone.
    """
    found, slot = placed.find(rays.track)
    rays, xyz = rays.where(found), placed.xyz[slot]
    images, count = np.unique(rays.image, return_counts=True)
    images = images[count >= MIN_POINTS]
    if not len(images):
        return f"no image sees {MIN_POINTS} points that the other period places"
    images = images[:: len(images) // MAX_IMAGES + 1]
    found_poses = [_localise_one(rays.where(rays.image == i), xyz[rays.image == i]) for i in images]
    spread = placed.covariance[slot]
    poses, differences = [], []
    for i, pose in zip(images, found_poses, strict=True):
        if pose is not None:
            mine = rays.image == i
            poses.append((rays.pose[np.flatnonzero(mine)[0]], pose))
            differences.append(_expected(rays.where(mine), xyz[mine], spread[mine], pose))
    if not poses:
        return f"none of {len(images)} images could be localised from the other period"
    angle = np.array([rotation_angle(new[:3, :3] @ old[:3, :3].T) for old, new in poses])
    moved = np.array(
        [np.linalg.norm(camera_centre(new) - camera_centre(old)) for old, new in poses]
    )
    noise = np.array(differences)
    return Localisation(
        images=len(poses),
        tried=len(images),
        rotation=float(np.median(angle)),
        centre=float(np.median(moved)),
        rotation_excess=_excess(angle, noise[:, 0]),
        centre_excess=_excess(moved, noise[:, 1]),
    )


def _excess(size: Array, noise: Array) -> Excess:
    """Root of the median square after the expected square is subtracted.

    Args:
        size: Differences of the images. [n]
        noise: Expected variance of each. [n]
    """
    beyond = size**2 - noise
    middle = float(np.median(beyond))
    spread = SIGMA * float(np.median(np.abs(beyond - middle))) / np.sqrt(len(size))
    return Excess(
        value=float(np.sqrt(max(0.0, middle))), low=float(np.sqrt(max(0.0, middle - 2 * spread)))
    )


def _expected(rays: Rays, xyz: Array, spread: Array, pose: Array) -> tuple[float, float]:
    """Variance of the pose that noise causes: rotation in degrees squared, centre in squared units.

    Least squares with equal weights on points of unequal certainty: ``N^-1 M N^-1`` with
    ``N = J^T J`` and ``M = J^T V J``.
    """
    rays = replace(rays, pose=np.broadcast_to(pose, (len(rays), 4, 4)))
    residual, by_point, _ = project(rays, xyz)
    variance = transfer_variance(by_point, spread)
    square = (residual**2).sum(axis=1) / variance
    good = np.isfinite(square) & (np.linalg.norm(residual, axis=1) < INLIER_PIXELS)
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    motion = generators(local)[:, :, :6]
    jacobian = np.einsum("nki,ji,njm->nkm", by_point, pose[:3, :3], motion)[good]
    noise = max(float(np.median(square[good])) / 1.1774**2, NOISE_FLOOR**2)
    normal = np.einsum("nki,nkj->ij", jacobian, jacobian)
    middle = np.einsum("nki,n,nkj->ij", jacobian, variance[good] * noise, jacobian)
    inverse = np.linalg.pinv(normal)
    covariance = inverse @ middle @ inverse
    turn = float(np.trace(covariance[3:, 3:])) * np.degrees(1.0) ** 2
    return turn, float(np.trace(covariance[:3, :3]))


def _localise_one(rays: Rays, xyz: Array) -> Array | None:
    """Pose by PnP with RANSAC, refined on its inliers; the pose in the model is not used."""
    import cv2

    step = len(rays) // MAX_POINTS + 1
    middle = xyz.mean(axis=0)
    points = np.ascontiguousarray(xyz[::step] - middle)
    focal = rays.focal[0]
    pixels = np.ascontiguousarray(rays.uv[::step] * focal)
    K = np.diag([focal[0], focal[1], 1.0])
    try:
        good, turn, shift, inliers = cv2.solvePnPRansac(
            points, pixels, K, None,
            flags=cv2.SOLVEPNP_SQPNP, reprojectionError=INLIER_PIXELS,
            iterationsCount=300, confidence=0.999,
        )  # fmt: skip
        if not good or inliers is None or len(inliers) < MIN_POINTS // 2:
            return None
        rows = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], K, None, turn, shift)
        rotation = cv2.Rodrigues(turn)[0]
    except cv2.error:  # degenerate points
        return None
    return pose_from_rotation_translation(rotation, shift.ravel() - rotation @ middle)
