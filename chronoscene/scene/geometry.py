"""Poses, similarity transforms and intrinsics.

Frames and pixels are stated in CONVENTIONS.md: ``cam_from_world`` maps world to camera, +x right,
+y down, +z forward; pixel (0, 0) is centred at (0.5, 0.5); quaternions are wxyz. Everything here
is float64 numpy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def rotation_from_quaternion(quaternion: ArrayLike) -> Array:
    """Rotation matrices of quaternions wxyz, which need not be unit. [..., 4] -> [..., 3, 3]"""
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
    """Unit quaternion wxyz with w >= 0 of a rotation matrix. [3, 3] -> [4]

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
    """Rigid 4x4 matrix of a rotation [3, 3] and a translation [3]."""
    pose = np.eye(4)
    pose[:3, :3] = rotation
    pose[:3, 3] = translation
    return pose


def camera_centre(cam_from_world: Array) -> Array:
    """Camera centres in the world of poses [..., 4, 4] -> [..., 3]."""
    rotation, translation = cam_from_world[..., :3, :3], cam_from_world[..., :3, 3]
    return -np.einsum("...ji,...j->...i", rotation, translation)


@dataclass(frozen=True, slots=True)
class Sim3:
    """Similarity ``x -> scale * rotation @ x + translation``, named ``target_from_source``."""

    scale: float
    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> Sim3:
        return cls(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: ArrayLike) -> Array:
        """Transform points. [..., 3]"""
        points = np.asarray(points, dtype=np.float64)
        return self.scale * points @ self.rotation.T + self.translation

    def apply_to_pose(self, cam_from_source: Array) -> Array:
        """Express a camera pose in the target frame; depths grow by ``scale``. [..., 4, 4]"""
        pose = np.array(cam_from_source, dtype=np.float64)
        rotation = pose[..., :3, :3] @ self.rotation.T
        pose[..., :3, 3] = self.scale * pose[..., :3, 3] - rotation @ self.translation
        pose[..., :3, :3] = rotation
        return pose

    def inverse(self) -> Sim3:
        return Sim3(
            1.0 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale
        )

    def to_matrix(self) -> Array:
        """The 4x4 matrix [[scale * rotation, translation], [0, 1]]."""
        return pose_from_rotation_translation(self.scale * self.rotation, self.translation)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Sim3:
        """Inverse of `to_matrix`."""
        m = np.asarray(matrix, dtype=np.float64)
        scale = float(np.cbrt(np.linalg.det(m[:3, :3])))
        return cls(scale, m[:3, :3] / scale, m[:3, 3].copy())
