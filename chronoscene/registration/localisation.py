"""Symmetric check: images of one period are localised anew, from points of the other alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.geometry import camera_centre, pose_from_rotation_translation
from chronoscene.registration.misalignment import rotation_angle
from chronoscene.registration.rays import Array, Placed, Rays

FEWEST_POINTS = 12
"""Points of the other period that an image must see."""

MOST_POINTS = 400
MOST_IMAGES = 60

INLIER_PIXELS = 6.0


@dataclass(frozen=True, slots=True)
class Localisation:
    """Difference between the poses of the model and those found from the other period."""

    images: int
    """Images that were localised."""
    tried: int
    """Images that see enough points of the other period."""
    rotation: float
    """Median, degrees."""
    largest_rotation: float
    centre: float
    """Median, world units."""
    largest_centre: float


def localise(rays: Rays, placed: Placed) -> Localisation | str:
    """Pose of each image by the points that the other period placed, against its pose in the model.

    Args:
        rays: Observations by the images of the period that is localised.
        placed: Points by the images of the other period alone.
    """
    found, slot = placed.find(rays.track)
    rays, xyz = rays.where(found), placed.xyz[slot]
    images, count = np.unique(rays.image, return_counts=True)
    images = images[count >= FEWEST_POINTS]
    if not len(images):
        return f"no image sees {FEWEST_POINTS} points that the other period places"
    images = images[:: len(images) // MOST_IMAGES + 1]
    found_poses = [_localise_one(rays.where(rays.image == i), xyz[rays.image == i]) for i in images]
    pairs = [
        (rays.pose[np.flatnonzero(rays.image == i)[0]], p)
        for i, p in zip(images, found_poses, strict=True)
        if p is not None
    ]
    if not pairs:
        return f"none of {len(images)} images could be localised from the other period"
    angle = [rotation_angle(new[:3, :3] @ old[:3, :3].T) for old, new in pairs]
    moved = [float(np.linalg.norm(camera_centre(new) - camera_centre(old))) for old, new in pairs]
    return Localisation(
        images=len(pairs),
        tried=len(images),
        rotation=float(np.median(angle)),
        largest_rotation=max(angle),
        centre=float(np.median(moved)),
        largest_centre=max(moved),
    )


def _localise_one(rays: Rays, xyz: Array) -> Array | None:
    """Pose by perspective-n-point with RANSAC, refined on its inliers. The pose is not a start."""
    import cv2

    step = len(rays) // MOST_POINTS + 1
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
        if not good or inliers is None or len(inliers) < FEWEST_POINTS // 2:
            return None
        rows = inliers.ravel()
        turn, shift = cv2.solvePnPRefineLM(points[rows], pixels[rows], K, None, turn, shift)
        rotation = cv2.Rodrigues(turn)[0]
    except cv2.error:  # degenerate points
        return None
    return pose_from_rotation_translation(rotation, shift.ravel() - rotation @ middle)
