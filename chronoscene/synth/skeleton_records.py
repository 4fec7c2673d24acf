"""Bulk writing of COLMAP's binary files: seconds less per scene than one object at a time.

The records are described in `chronoscene.colmap_records`, which reads them. Ids count from 1 in
the order of the arrays.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from chronoscene.geometry import quaternion_from_rotation
from chronoscene.scene import Camera

Array = NDArray[np.float64]
Index = NDArray[np.int64]

PINHOLE = 1
"""COLMAP's id of the camera model."""
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])


def write_cameras(path: Path, camera: Camera) -> None:
    """Write ``cameras.bin`` with one PINHOLE camera."""
    assert camera.model == "PINHOLE"
    head = struct.pack("<QiiQQ", 1, camera.camera_id, PINHOLE, camera.width, camera.height)
    path.write_bytes(head + struct.pack("<4d", *camera.params))


def write_images(
    path: Path,
    names: Sequence[str],
    poses: Array,
    camera_id: int,
    observations: tuple[Index, Index, Array],
) -> Index:
    """Write ``images.bin``.

    Args:
        path: The file.
        names: Names of the images. I of them
        poses: World to camera. [I, 4, 4]
        camera_id: Of all images.
        observations: Point and image index of each [M], and its pixel position [M, 2].

    Returns:
        Index of each observation among the keypoints of its image. [M]
    """
    point, image, xy = observations
    order = np.lexsort((point, image))
    ends = np.searchsorted(image[order], np.arange(len(names) + 1))
    keypoint = np.empty(len(order), np.int64)
    keypoint[order] = np.arange(len(order)) - ends[image[order]]
    records = np.empty(len(order), _KEYPOINT)
    records["xy"], records["point_id"] = xy[order], point[order] + 1
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(names)))
        for i, name in enumerate(names):
            quaternion = quaternion_from_rotation(poses[i, :3, :3])
            file.write(struct.pack("<i7di", i + 1, *quaternion, *poses[i, :3, 3], camera_id))
            file.write(name.encode() + b"\0" + struct.pack("<Q", ends[i + 1] - ends[i]))
            file.write(records[ends[i] : ends[i + 1]].tobytes())
    return keypoint


def write_points(
    path: Path, xyz: Array, rgb: NDArray[np.uint8], error: Array, tracks: tuple[Index, Index, Index]
) -> None:
    """Write ``points3D.bin``, shortest tracks first: records of equal length are one array.

    Args:
        path: The file.
        xyz: World units. [P, 3]
        rgb: [P, 3]
        error: Mean reprojection error in pixels. [P]
        tracks: Point, image index and keypoint index of each observation. [M] each
    """
    point, image, keypoint = tracks
    order = np.lexsort((image, point))
    pairs = np.column_stack([image + 1, keypoint])[order]
    length = np.bincount(point, minlength=len(xyz))
    start = np.cumsum(length) - length
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(xyz)))
        for n in np.unique(length).tolist():
            rows = np.flatnonzero(length == n)
            records = np.empty(len(rows), _point_record(n))
            records["id"], records["xyz"], records["rgb"] = rows + 1, xyz[rows], rgb[rows]
            records["error"], records["length"] = error[rows], n
            records["track"] = pairs[start[rows, None] + np.arange(n)]
            file.write(records.tobytes())


def _point_record(length: int) -> np.dtype[np.void]:
    return np.dtype(
        [
            ("id", "<u8"),
            ("xyz", "<f8", 3),
            ("rgb", "u1", 3),
            ("error", "<f8"),
            ("length", "<u8"),
            ("track", "<i4", (length, 2)),
        ]
    )
