"""A path around the target of the cameras of a scene."""

from __future__ import annotations

import numpy as np

from chronoscene.arrays import Array
from chronoscene.scene.geometry import camera_centre, look_at

MAX_GAP = 2 * np.pi / 3
"""Angle without any camera beyond which the path swings to and fro instead of going around."""


def find_up(poses: Array) -> Array:
    """Find the up direction of cameras that are held level. [C, 4, 4] -> [3]

    It is the one to which the x axes of the cameras are most nearly at right angles. Where these
    are all parallel, it is also at right angles to the plane in which the cameras are: they fly
    over the ground. Where they are in a line, what is up and back in the images decides.
    """
    right, down, forward = np.moveaxis(poses[:, :3, :3], 1, 0)
    guess = -(down + forward).mean(axis=0)
    guess /= max(np.linalg.norm(guess), 1e-9)
    centres = camera_centre(poses)
    centres = centres - centres.mean(axis=0)
    spread = centres.T @ centres / max((centres**2).sum(), 1e-18)
    doubt = 0.01 * spread - 1e-4 * np.outer(guess, guess)
    up = np.linalg.eigh(right.T @ right / len(poses) + doubt)[1][:, 0]
    return np.asarray(up if up @ guess >= 0 else -up)


def orbit(
    poses: Array,
    points: Array,
    count: int,
    *,
    radius: float | None = None,
    height: float | None = None,
) -> Array:
    """Make poses around the median of the points.

    The path begins where the first camera is. It is a full circle if there are cameras on all
    sides, else it swings over the side that has them.

    Args:
        poses: ``cam_from_world`` of the cameras. [C, 4, 4]
        points: Points of the scene; those that are not finite do not count. [P, 3]
        count: Number of poses.
        radius: Level distance from the median of the points; None for the median distance of the
            cameras.
        height: Height above the median of the points; None for the median height of the cameras.

    Returns:
        poses: The end of the path leads to its beginning. [count, 4, 4]
    """
    up, target = find_up(poses), np.median(points[np.isfinite(points).all(axis=1)], axis=0)
    offsets = camera_centre(poses) - target
    heights = offsets @ up
    level = offsets - heights[:, None] * up
    distances = np.linalg.norm(level, axis=1)
    height = float(np.median(heights)) if height is None else height
    radius = float(np.median(distances)) if radius is None else radius
    # A camera right above the target would have no direction that is up in its image.
    radius = max(radius, 0.05 * abs(height), 1e-6)
    x_axis = level[np.argmax(distances)] / max(distances.max(), 1e-9)
    if distances.max() <= 1e-9:
        x_axis = np.linalg.svd(up[None])[2][1]
    y_axis = np.cross(up, x_axis)
    angles = np.arctan2(level @ y_axis, level @ x_axis)
    turns = angles[0] + _turns(np.sort((angles - angles[0]) % (2 * np.pi)), count)
    ring = np.cos(turns)[:, None] * x_axis + np.sin(turns)[:, None] * y_axis
    eyes = target + radius * ring + height * up
    return np.stack([look_at(eye, target, up=up) for eye in eyes])


def _turns(angles: Array, count: int) -> Array:
    """Compute angles of a path from 0 on, for cameras at sorted angles 0..2 pi. [count]"""
    share = np.arange(count) / count
    gaps = np.diff(angles, append=angles[0] + 2 * np.pi)
    widest = int(gaps.argmax())
    if gaps[widest] <= MAX_GAP:
        return 2 * np.pi * share
    high, low = angles[widest], angles[widest] + gaps[widest] - 2 * np.pi
    middle, half = (high + low) / 2, (high - low) / 2
    start = np.arcsin(np.clip(-middle / half, -1, 1)) if half > 0 else 0.0
    return middle + half * np.sin(start + 2 * np.pi * share)
