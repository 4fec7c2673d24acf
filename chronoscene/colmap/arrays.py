"""The parts of a COLMAP model as arrays, with nothing checked: what its files say."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.tracks import select_tracks


@dataclass(frozen=True, slots=True, eq=False)
class RawImages:
    """Registered images in the order of the file (I images, K keypoints)."""

    ids: NDArray[np.int64]
    """[I]"""
    names: tuple[str, ...]
    """Bytes that are not UTF-8 as lone surrogates, as Python has them in file names."""
    quaternions: NDArray[np.float64]
    """wxyz, as stored. [I, 4]"""
    translations: NDArray[np.float64]
    """[I, 3]"""
    camera_ids: NDArray[np.int64]
    """[I]"""
    keypoint_start: NDArray[np.int64]
    """Keypoints of image i are ``keypoint_start[i]:keypoint_start[i + 1]``. [I + 1]"""
    keypoint_xy: NDArray[np.float64]
    """Pixels. [K, 2]"""
    keypoint_point: NDArray[np.int64]
    """Point id, negative for none. [K]"""

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class RawPoints:
    """Sparse points sorted by id (P points, M observations)."""

    ids: NDArray[np.int64]
    """[P]"""
    xyz: NDArray[np.float64]
    """World units. [P, 3]"""
    rgb: NDArray[np.uint8]
    """[P, 3]"""
    error: NDArray[np.float64]
    """As stored, in pixels. [P]"""
    track_start: NDArray[np.int64]
    """Observations of point i are ``track_start[i]:track_start[i + 1]``. [P + 1]"""
    track_image: NDArray[np.int64]
    """Image id. [M]"""
    track_keypoint: NDArray[np.int64]
    """Index among the keypoints of the image. [M]"""

    def __len__(self) -> int:
        return len(self.ids)

    def select(self, keep: NDArray[np.bool_]) -> RawPoints:
        """Some of the points, in the same order, each with all of its observations.

        Args:
            keep: Which points. [P]
        """
        track_start, observed = select_tracks(self.track_start, keep)
        return RawPoints(
            ids=self.ids[keep],
            xyz=self.xyz[keep],
            rgb=self.rgb[keep],
            error=self.error[keep],
            track_start=track_start,
            track_image=self.track_image[observed],
            track_keypoint=self.track_keypoint[observed],
        )


Pose = tuple[float, ...]
"""Quaternion wxyz and translation."""

IDENTITY: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

Sensor = tuple[int, int]
"""Type and id."""

CAMERA = 0
"""Type of the sensors that are cameras."""


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Where a rig was when its images were taken."""

    frame_id: int
    rig_id: int
    rig_from_world: Pose
    data: tuple[tuple[Sensor, int], ...]
    """Sensors, and the ids of what they took: of cameras, image ids."""


@dataclass(frozen=True, slots=True)
class RawRigs:
    """``rigs`` and ``frames``, which COLMAP writes beside the three other files since 3.12."""

    rigs: dict[int, dict[Sensor, Pose | None]]
    """By rig id, the poses of its sensors (``sensor_from_rig``), None if not known."""
    frames: tuple[RawFrame, ...]


@dataclass(frozen=True, slots=True)
class Damage:
    """Why a file of the model, or a line of it, cannot be read."""

    file: str
    """Name of the file, with a line number for text (``cameras.txt:3``)."""
    expected: str
    found: str


class DamagedError(Exception):
    """Carries damages out of a reader."""

    def __init__(self, *damages: Damage) -> None:
        super().__init__("; ".join(f"{d.file}: {d.found}" for d in damages))
        self.damages = damages
