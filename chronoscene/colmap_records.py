"""Bulk reading of the records in COLMAP's binary files. Plain numpy.

Two reasons for a reader beside pycolmap: pycolmap gives points and observations one Python object
at a time (seconds for a scene of half a million points), and it does not notice that a file ends
early. Every length is checked here against the size of the file before it is used.

Records are little endian; a count comes first (u64). Camera: i32 id, i32 model, u64 width, u64
height, f64 parameters. Image: i32 id, f64 quaternion wxyz, f64 translation, i32 camera, name ended
by a zero byte, u64 n, then n times (f64 x, f64 y, i64 point id or -1). Point: u64 id, f64 xyz, u8
rgb, f64 error, u64 n, then n times (i32 image id, i32 keypoint index). Rig: u32 id, u32 number
of sensors, of the first its i32 type and u32 id, of each other one also u8 and, if that is set, a
pose (7 f64). Frame: u32 id, u32 rig, 7 f64, u32 n, then n times (i32 sensor type, u32 sensor id,
u64 image id).
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from chronoscene.errors import SceneError

CAMERA_PARAMETERS = (3, 4, 4, 5, 8, 8, 12, 5, 4, 5, 12, 16, 4, 5, 3, 4, 6, 2)
"""Number of parameters by COLMAP's model id, SIMPLE_PINHOLE (0) to EQUIRECTANGULAR (17)."""

_COUNT = struct.Struct("<Q")
_CAMERA_HEAD = struct.Struct("<iiQQ")
_IMAGE_HEAD = struct.Struct("<i7di")
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
_POINT_HEAD = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8")])
_POINT_BYTES = _POINT_HEAD.itemsize + _COUNT.size
_TRACK_BYTES = 8
_RIG_HEAD = struct.Struct("<II")
_SENSOR = struct.Struct("<iI")
_POSE_BYTES = 7 * 8
_FRAME_HEAD = struct.Struct("<II7dI")
_FRAME_IMAGE_BYTES = 16

T = TypeVar("T")


@dataclass(frozen=True, slots=True, eq=False)
class PointRecords:
    """The points of a model, sorted by id (P points, M observations)."""

    heads: NDArray[np.void]
    """Fields ``id``, ``xyz``, ``rgb`` and ``error``. [P]"""
    track_start: NDArray[np.int64]
    """Observations of point i are ``track_start[i]:track_start[i + 1]``. [P + 1]"""
    tracks: NDArray[np.int32]
    """Image id and keypoint index of each observation. [M, 2]"""


def read_points(path: Path) -> PointRecords:
    """Read ``points3D.bin``.

    Raises:
        SceneError: If the file cannot be read or ends inside a record.
    """
    return _guarded(path, _walk_points)


@dataclass(frozen=True, slots=True, eq=False)
class CameraRecord:
    """One record of ``cameras.bin``."""

    camera_id: int
    model_id: int
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True, slots=True, eq=False)
class ImageRecord:
    """One record of ``images.bin``, whatever it says."""

    image_id: int
    quaternion: tuple[float, float, float, float]
    """wxyz as stored: may be anything."""
    translation: tuple[float, float, float]
    camera_id: int
    name: bytes
    """As stored: may be no UTF-8."""
    xy: NDArray[np.float64]
    """Keypoints in pixels. [n, 2]"""
    point_ids: NDArray[np.int64]
    """Point of each keypoint, -1 for none. [n]"""


def read_cameras(path: Path) -> list[CameraRecord]:
    """Read ``cameras.bin``.

    Raises:
        SceneError: If the file cannot be read, ends inside a record, or has an unknown model.
    """
    return _guarded(path, _walk_cameras)


def read_images(path: Path) -> list[ImageRecord]:
    """Read ``images.bin`` without judging names and poses.

    Raises:
        SceneError: If the file cannot be read or ends inside a record.
    """
    return _guarded(path, _walk_images)


def read_keypoints(path: Path) -> dict[int, NDArray[np.float64]]:
    """Read the pixel positions in ``images.bin``: image id to keypoints [n, 2].

    Raises:
        SceneError: If the file cannot be read or ends inside a record.
    """
    return {image.image_id: image.xy for image in read_images(path)}


def check_records(folder: Path) -> None:
    """Check the small files of a model: ``cameras.bin``, and ``rigs.bin`` and ``frames.bin``.

    The last two are absent in models written by COLMAP before 3.12.

    Raises:
        SceneError: If a file ends inside a record, or has a camera model that COLMAP does not know.
    """
    _guarded(folder / "cameras.bin", _walk_cameras)
    for stem, walk in (("rigs", _walk_rigs), ("frames", _walk_frames)):
        path = folder / f"{stem}.bin"
        if path.exists():
            _guarded(path, walk)


class _DamagedError(Exception):
    """What is wrong inside a file, in words."""


def _guarded(path: Path, walk: Callable[[bytes], T]) -> T:
    try:
        return walk(path.read_bytes())
    except OSError as error:
        found = error.strerror or "unreadable"
    except (struct.error, ValueError, IndexError):
        found = "a file that ends inside a record"
    except _DamagedError as error:
        found = str(error)
    raise SceneError(
        path,
        expected="complete COLMAP records",
        found=found,
        todo="copy the file again or write the model again with COLMAP",
    )


def _count(data: bytes, smallest_record: int) -> int:
    """The leading count, refused if so many records cannot fit into the file."""
    (count,) = _COUNT.unpack_from(data, 0)
    if count * smallest_record > len(data) - _COUNT.size:
        raise _DamagedError(f"{count} records announced in {len(data)} bytes")
    return int(count)


def _finish(data: bytes, at: int) -> None:
    if at != len(data):
        raise _DamagedError(f"{len(data) - at} bytes after the last record")


def _walk_cameras(data: bytes) -> list[CameraRecord]:
    cameras = []
    at = _COUNT.size
    for _ in range(_count(data, _CAMERA_HEAD.size)):
        camera_id, model, width, height = _CAMERA_HEAD.unpack_from(data, at)
        if not 0 <= model < len(CAMERA_PARAMETERS):
            raise _DamagedError(f"camera {camera_id} with the unknown model id {model}")
        at += _CAMERA_HEAD.size
        params = struct.unpack_from(f"<{CAMERA_PARAMETERS[model]}d", data, at)
        cameras.append(CameraRecord(camera_id, model, width, height, params))
        at += 8 * len(params)
    _finish(data, at)
    return cameras


def _walk_rigs(data: bytes) -> None:
    at = _COUNT.size
    for _ in range(_count(data, _RIG_HEAD.size)):
        _rig_id, sensors = _RIG_HEAD.unpack_from(data, at)
        at += _RIG_HEAD.size + (_SENSOR.size if sensors else 0)
        if sensors * _SENSOR.size > len(data):
            raise _DamagedError(f"a rig with {sensors} sensors, more than the file has")
        for _ in range(sensors - 1):
            at += _SENSOR.size
            has_pose = data[at]
            at += 1 + (_POSE_BYTES if has_pose else 0)
    _finish(data, at)


def _walk_frames(data: bytes) -> None:
    at = _COUNT.size
    for _ in range(_count(data, _FRAME_HEAD.size)):
        (images,) = struct.unpack_from("<I", data, at + _FRAME_HEAD.size - 4)
        at += _FRAME_HEAD.size + _FRAME_IMAGE_BYTES * images
        if at > len(data):
            raise _DamagedError(f"a frame with {images} images, more than the file has")
    _finish(data, at)


def _walk_images(data: bytes) -> list[ImageRecord]:
    images: dict[int, ImageRecord] = {}
    at = _COUNT.size
    for _ in range(_count(data, _IMAGE_HEAD.size + 1 + _COUNT.size)):
        image_id, qw, qx, qy, qz, tx, ty, tz, camera_id = _IMAGE_HEAD.unpack_from(data, at)
        end = data.index(0, at + _IMAGE_HEAD.size)
        name = data[at + _IMAGE_HEAD.size : end]
        at = end + 1
        (length,) = _COUNT.unpack_from(data, at)
        at += _COUNT.size
        if length * _KEYPOINT.itemsize > len(data) - at:
            raise _DamagedError(f"image {image_id} with {length} keypoints, more than the file has")
        if image_id in images:
            raise _DamagedError(f"image id {image_id} twice")
        records = np.frombuffer(data, _KEYPOINT, count=length, offset=at)
        images[image_id] = ImageRecord(
            image_id=image_id,
            quaternion=(qw, qx, qy, qz),
            translation=(tx, ty, tz),
            camera_id=camera_id,
            name=name,
            xy=np.ascontiguousarray(records["xy"]),
            point_ids=np.ascontiguousarray(records["point_id"]),
        )
        at += length * _KEYPOINT.itemsize
    _finish(data, at)
    return list(images.values())


def _walk_points(data: bytes) -> PointRecords:
    count = _count(data, _POINT_BYTES)
    offsets = np.empty(count, np.int64)
    lengths = np.empty(count, np.int64)
    unpack = _COUNT.unpack_from
    at, end = _COUNT.size, len(data)
    for i in range(count):
        (length,) = unpack(data, at + _POINT_HEAD.itemsize)
        if length > end:
            raise _DamagedError(f"record {i} with {length} observations, more than the file has")
        offsets[i] = at
        lengths[i] = length
        at += _POINT_BYTES + _TRACK_BYTES * length
    _finish(data, at)
    return _gather_points(np.frombuffer(data, np.uint8), offsets, lengths)


def _gather_points(
    data: NDArray[np.uint8], offsets: NDArray[np.int64], lengths: NDArray[np.int64]
) -> PointRecords:
    """Copy the records at ``offsets`` out of the file, in the order of the point ids."""
    heads = data[offsets[:, None] + np.arange(_POINT_HEAD.itemsize)]
    heads = np.ascontiguousarray(heads).view(_POINT_HEAD)[:, 0]
    order = np.argsort(heads["id"], kind="stable")
    ids = heads["id"][order]
    if (ids[1:] == ids[:-1]).any():
        raise _DamagedError(f"point id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    if len(ids) and ids[-1] > np.iinfo(np.int64).max:
        raise _DamagedError(f"point id {ids[-1]}, more than 63 bits")
    start = np.concatenate([[0], np.cumsum(lengths[order])])
    # Observation j of point i begins track_start[j] pairs after the first one of the point.
    first = (offsets + _POINT_BYTES)[order]
    at = np.repeat(first - _TRACK_BYTES * start[:-1], lengths[order])
    at += _TRACK_BYTES * np.arange(start[-1])
    tracks = np.empty((len(at), 2), np.int32)
    for column in (0, 1):
        raw = data[(at + 4 * column)[:, None] + np.arange(4)]
        tracks[:, column] = np.ascontiguousarray(raw).view("<i4")[:, 0]
    return PointRecords(heads[order], start, tracks)
