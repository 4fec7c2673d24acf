"""Camera paths through views that were kept, as the files that ``render --cameras`` takes."""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import PchipInterpolator
from scipy.spatial.transform import Rotation, Slerp

from chronoscene.arrays import Array
from chronoscene.formats.shared.transforms import opengl_from_pose
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation

FPS = 24
"""Pictures a second of a path, the default of ``render --fps``."""
LONGEST = 1280  # Longer side of the pictures in pixels


@dataclass(frozen=True, slots=True, eq=False)
class KeyView:
    """A camera in the world, and the period that it shows."""

    pose: Array
    """``cam_from_world``. [4, 4]"""
    fov: float
    """Vertical, in radians."""
    period: float


def interpolate(views: Sequence[KeyView], count: int) -> list[KeyView]:
    """Return views along a smooth path through all of these, at equal steps of time."""
    if len(views) == 1:
        return [*views] * count
    times, at = np.arange(len(views)), np.linspace(0, len(views) - 1, count)
    poses = np.stack([view.pose for view in views])
    turned = Slerp(times, Rotation.from_matrix(poses[:, :3, :3]))(at).as_matrix()
    others = [(*camera_centre(v.pose), v.fov, v.period) for v in views]
    return [
        KeyView(pose_from_rotation_translation(R, -R @ row[:3]), row[3], row[4])
        for R, row in zip(turned, PchipInterpolator(times, others)(at), strict=True)
    ]


def path_file(
    views: Sequence[KeyView], seconds: float, size: tuple[int, int], periods: int, *, whole: bool
) -> bytes:
    """Return a camera path of nerfstudio's form.

    Args:
        views: Views that the path passes through.
        seconds: Length of the path.
        size: Width and height, whose ratio the pictures get.
        periods: Number of periods of the scene.
        whole: Round periods, for methods that have nothing between.
    """
    width, height = (max(2, 2 * round(LONGEST / max(size) * side / 2)) for side in size)
    cameras = [
        {
            "camera_to_world": opengl_from_pose(view.pose).ravel().tolist(),
            "fov": math.degrees(view.fov),
            "render_time": (round(view.period) if whole else view.period) / max(periods - 1, 1),
        }
        for view in interpolate(views, max(2, round(seconds * FPS)))
    ]
    shape = {"camera_type": "perspective", "render_width": width, "render_height": height}
    return json.dumps(shape | {"fps": FPS, "seconds": seconds, "camera_path": cameras}).encode()
