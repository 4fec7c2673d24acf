"""Rotations and poses.

Frames and pixels are stated in CONVENTIONS.md: ``cam_from_world`` maps world to camera, +x right,
+y down, +z forward; pixel (0, 0) is centred at (0.5, 0.5); quaternions are wxyz. Everything here
is float64 numpy.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array

Z_AXIS = np.array([0.0, 0.0, 1.0])


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Convert quaternions wxyz, of any length, to rotation matrices. [..., 4] -> [..., 3, 3]"""
    q = np.asarray(quaternion, dtype=np.float64)
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(q, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)


def quaternion_from_rotation(rotation: ArrayLike) -> Array:
    """Convert a rotation matrix to a unit quaternion wxyz with w >= 0. [3, 3] -> [4]

    Source: Shepperd 1978; the largest of the four candidates is taken, so no division is unstable.
    """
    m = np.asarray(rotation, dtype=np.float64)
    trace = np.trace(m)
    squares = np.array([trace, m[0, 0], m[1, 1], m[2, 2]])
    i = int(np.argmax(squares))
    if i == 0:
        q = np.array([1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]])
    else:
        a = i - 1
        b, c = (a + 1) % 3, (a + 2) % 3
        q = np.empty(4)
        q[0] = m[c, b] - m[b, c]
        q[1 + a] = 1 + m[a, a] - m[b, b] - m[c, c]
        q[1 + b] = m[b, a] + m[a, b]
        q[1 + c] = m[c, a] + m[a, c]
    q /= np.linalg.norm(q)
    return -q if q[0] < 0 else q


def pose_from_rotation_translation(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Combine a rotation [3, 3] and a translation [3] in a rigid 4x4 matrix."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def is_rotation(matrix: Array, tolerance: float) -> bool:
    """Return True if R R^T is the identity within a tolerance; False for NaN. [3, 3]"""
    return bool(np.abs(matrix @ matrix.T - np.eye(3)).max() <= tolerance)


def camera_centre(cam_from_world: Array) -> Array:
    """Compute camera centres in the world of poses. [..., 4, 4] -> [..., 3]"""
    rotation, translation = cam_from_world[..., :3, :3], cam_from_world[..., :3, 3]
    return -np.einsum("...ji,...j->...i", rotation, translation)


def look_at(eye: Array, target: Array, roll: float = 0.0, up: Array = Z_AXIS) -> Array:
    """Compute cam_from_world of a camera at ``eye`` that looks at ``target``. [4, 4]"""
    forward = (target - eye) / np.linalg.norm(target - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    down = np.cross(forward, right)
    c, s = np.cos(roll), np.sin(roll)
    rotation = np.stack([c * right + s * down, c * down - s * right, forward])
    return pose_from_rotation_translation(rotation, -rotation @ eye)
