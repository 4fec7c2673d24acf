"""Symmetric check: images of one period are localised from points of the other alone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Ints
from chronoscene.registration.quality.misalignment import generators, rotation_angle
from chronoscene.registration.quality.rays import PlacedPoints, TrackRays, project
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation
from chronoscene.scene.similarity import median_and_nmad

MIN_POINTS = 12  # Points of the other period that an image must see

MAX_IMAGES = 60

INLIER_PIXELS = 6.0


@dataclass(frozen=True, slots=True)
class Excess:
    """Difference beyond what noise explains; 0 if noise explains all of it."""

    value: float
    low: float
    """Lower bound, from the spread over the images."""
    noise: float
    """Share that noise explains, by the median."""


@dataclass(frozen=True, slots=True)
class Localisation:
    """Differences between poses of the model and poses by the points of the other period."""

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


def localise(rays: TrackRays, placed: PlacedPoints) -> Localisation | str:
    """Localise images by the points of the other period, and compare with their poses.

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
    poses, noise = [], []
    for i in images:
        mine = np.flatnonzero(rays.image == i)
        found_pose = _localise_one(rays.where(mine), xyz[mine])
        if found_pose is not None:
            pose, used = found_pose
            poses.append((rays.pose[mine[0]], pose))
            noise.append(_variance(rays.where(mine[used]), xyz[mine[used]], pose))
    if not poses:
        return f"none of {len(images)} images could be localised from the other period"
    angle = rotation_angle(np.stack([new[:3, :3] @ old[:3, :3].T for old, new in poses]))
    moved = np.array(
        [np.linalg.norm(camera_centre(new) - camera_centre(old)) for old, new in poses]
    )
    turn, place = np.array(noise).T
    return Localisation(
        images=len(poses),
        tried=len(images),
        rotation=float(np.median(angle)),
        centre=float(np.median(moved)),
        rotation_excess=_excess(angle, turn),
        centre_excess=_excess(moved, place),
    )


def _excess(size: Array, noise: Array) -> Excess:
    """Root of the median square beyond the expected square.

    Args:
        size: Differences of the images. [n]
        noise: Expected variance of each. [n]
    """
    beyond = size**2 - noise
    middle, spread = median_and_nmad(beyond)
    spread /= np.sqrt(len(size))
    return Excess(
        value=float(np.sqrt(max(0.0, middle))),
        low=float(np.sqrt(max(0.0, middle - 2 * spread))),
        noise=float(np.sqrt(np.median(noise))),
    )


def _variance(rays: TrackRays, xyz: Array, pose: Array) -> tuple[float, float]:
    """Variance of a pose by least squares: rotation in degrees squared, centre in squared units.

    It is that of a sandwich estimator, ``N^-1 M N^-1`` with ``N = sum J^T J`` and
    ``M = sum J^T r r^T J`` over the points that the pose was fitted to: their certainty differs,
    and residuals have heavier tails than normal ones.

    Source: White 1980.
    """
    residual, by_point, _ = _project(rays, xyz, pose)
    local = xyz @ pose[:3, :3].T + pose[:3, 3]
    motion = generators(local)[:, :, :6]
    jacobian = np.nan_to_num(np.einsum("nki,ji,njm->nkm", by_point, pose[:3, :3], motion))
    score = np.einsum("nki,nk->ni", jacobian, np.nan_to_num(residual))
    inverse = np.linalg.pinv(np.einsum("nki,nkj->ij", jacobian, jacobian))
    left = 1 - 3 / len(rays)  # Degrees of freedom: six unknowns, two coordinates of each point
    covariance = inverse @ (score.T @ score) @ inverse / left
    turn = float(np.trace(covariance[3:, 3:])) * np.degrees(1.0) ** 2
    return turn, float(np.trace(covariance[:3, :3]))


def _project(rays: TrackRays, xyz: Array, pose: Array) -> tuple[Array, Array, Array]:
    """Project as `project` does, from another pose."""
    return project(replace(rays, pose=np.broadcast_to(pose, (len(rays), 4, 4))), xyz)


def _localise_one(rays: TrackRays, xyz: Array) -> tuple[Array, Ints] | None:
    """Estimate a pose by PnP with RANSAC, refined on its inliers; the pose and the inliers.

    The pose in the model is not used. Inliers are those of the pose that RANSAC returns: those of
    the few points it was drawn from would pull the pose to them.
    """
    import cv2

    middle = xyz.mean(axis=0)
    points = np.ascontiguousarray(xyz - middle)
    focal = rays.focal[0]
    pixels = np.ascontiguousarray(rays.uv * focal)
    K = np.diag([focal[0], focal[1], 1.0])

    def pose_of(turn: NDArray[Any], shift: NDArray[Any]) -> Array:
        rotation = cv2.Rodrigues(turn)[0]
        return pose_from_rotation_translation(rotation, shift.ravel() - rotation @ middle)

    try:
        good, turn, shift, _ = cv2.solvePnPRansac(
            points, pixels, K, None,
            flags=cv2.SOLVEPNP_SQPNP, reprojectionError=INLIER_PIXELS,
            iterationsCount=300, confidence=0.999,
        )  # fmt: skip
        if not good:
            return None
        residual = _project(rays, xyz, pose_of(turn, shift))[0]
        rows = np.flatnonzero(np.linalg.norm(residual, axis=1) < INLIER_PIXELS)
        if len(rows) < MIN_POINTS // 2:
            return None
        turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], K, None, turn, shift)
        return pose_of(turn, shift), rows
    except cv2.error:  # degenerate points
        return None
