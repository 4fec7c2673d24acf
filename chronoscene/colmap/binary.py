"""Bulk reading of the records in COLMAP's binary files. Plain numpy.

Two reasons for a reader beside pycolmap: pycolmap gives points and observations one Python object
at a time (seconds for a scene of half a million points), and it does not notice that a file ends
early. Every length is checked against the size of the file before it is used.

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.record_reader import COUNT, RecordError, RecordReader, read_records
from chronoscene.scene.cameras import CAMERA_MODELS, MODEL_NAMES

_CAMERA_HEAD = struct.Struct("<iiQQ")
_IMAGE_HEAD = struct.Struct("<i7di")
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])
"""A keypoint of an image."""
POINT_HEAD = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""What stands before the track of a point."""
_LENGTH_AT = POINT_HEAD.itemsize - COUNT.size
_TRACK_BYTES = 8
_RIG_HEAD = struct.Struct("<II")
_SENSOR_BYTES = 8
_POSE_BYTES = 7 * 8
_FRAME_HEAD = struct.Struct("<II7dI")
_FRAME_IMAGE_BYTES = 16


@dataclass(frozen=True, slots=True, eq=False)
class PointRecords:
    """The points of a model, sorted by id (P points, M observations)."""

    heads: NDArray[np.void]
    """See `POINT_HEAD`. [P]"""
    track_start: NDArray[np.int64]
    """Observations of point i are ``track_start[i]:track_start[i + 1]``. [P + 1]"""
    tracks: NDArray[np.int32]
    """Image id and keypoint index of each observation. [M, 2]"""


def read_points(path: Path) -> PointRecords:
    """Read ``points3D.bin``.

    Raises:
        SceneError: If the file cannot be read or ends inside a record.
    """
    return read_records(path, _walk_points)


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
    return read_records(path, _walk_cameras)


def read_images(path: Path) -> list[ImageRecord]:
    """Read ``images.bin`` in the order of the file, without judging ids, names and poses.

    Raises:
        SceneError: If the file cannot be read or ends inside a record.
    """
    return read_records(path, _walk_images)


def check_records(folder: Path) -> None:
    """Check the small files of a model: ``cameras.bin``, and ``rigs.bin`` and ``frames.bin``.

    The last two are absent in models written by COLMAP before 3.12.

    Raises:
        SceneError: If a file ends inside a record, or has a camera model that COLMAP does not know.
    """
    read_records(folder / "cameras.bin", _walk_cameras)
    for stem, walk in (("rigs", _walk_rigs), ("frames", _walk_frames)):
        path = folder / f"{stem}.bin"
        if path.exists():
            read_records(path, walk)


def _walk_cameras(reader: RecordReader) -> list[CameraRecord]:
    cameras = []
    for _ in reader.records("camera", _CAMERA_HEAD.size):
        camera_id, model, width, height = reader.unpack(_CAMERA_HEAD)
        if not 0 <= model < len(MODEL_NAMES):
            known = f"0..{len(MODEL_NAMES) - 1}"
            raise RecordError(f"the unknown model id {model} for camera {camera_id}, not {known}")
        count = len(CAMERA_MODELS[MODEL_NAMES[model]].params)
        params = reader.unpack(struct.Struct(f"<{count}d"))
        cameras.append(CameraRecord(camera_id, model, width, height, params))
    return cameras


def _walk_rigs(reader: RecordReader) -> None:
    for _ in reader.records("rig", _RIG_HEAD.size):
        _rig_id, sensors = reader.unpack(_RIG_HEAD)
        reader.parts = f"{sensors} sensors"
        reader.skip(_SENSOR_BYTES if sensors else 0)
        for _ in range(sensors - 1):
            has_pose = reader.data[reader.skip(_SENSOR_BYTES + 1) + _SENSOR_BYTES]
            reader.skip(_POSE_BYTES if has_pose else 0)


def _walk_frames(reader: RecordReader) -> None:
    for _ in reader.records("frame", _FRAME_HEAD.size):
        images = reader.unpack(_FRAME_HEAD)[-1]
        reader.parts = f"{images} images"
        reader.skip(_FRAME_IMAGE_BYTES * images)


def _walk_images(reader: RecordReader) -> list[ImageRecord]:
    images = []
    for _ in reader.records("image", _IMAGE_HEAD.size + 1 + COUNT.size):
        image_id, qw, qx, qy, qz, tx, ty, tz, camera_id = reader.unpack(_IMAGE_HEAD)
        name = reader.text()
        (length,) = reader.unpack(COUNT)
        reader.parts = f"{length} keypoints"
        begin = reader.skip(length * KEYPOINT.itemsize)
        records = np.frombuffer(reader.data, KEYPOINT, count=length, offset=begin)
        images.append(
            ImageRecord(
                image_id=image_id,
                quaternion=(qw, qx, qy, qz),
                translation=(tx, ty, tz),
                camera_id=camera_id,
                name=name,
                xy=np.ascontiguousarray(records["xy"]),
                point_ids=np.ascontiguousarray(records["point_id"]),
            )
        )
    return images


def _walk_points(reader: RecordReader) -> PointRecords:
    """One step per record, since each says only how long itself is; all else in whole columns."""
    offsets = _quick_offsets(reader.data)
    if offsets is None:
        offsets = _checked_offsets(reader)
    begin = np.array(offsets, np.int64)
    lengths = (np.diff(begin) - POINT_HEAD.itemsize) // _TRACK_BYTES
    return _gather_points(reader.data, begin[:-1], lengths)


def _quick_offsets(data: bytes) -> list[int] | None:
    """Where the records begin and the last ends, if the file is as it should be."""
    if len(data) < COUNT.size:
        return None
    (count,) = COUNT.unpack_from(data)
    if count * POINT_HEAD.itemsize > len(data):
        return None
    unpack, head, at = COUNT.unpack_from, POINT_HEAD.itemsize, COUNT.size
    offsets = [at]
    try:
        for _ in range(count):
            at += head + _TRACK_BYTES * unpack(data, at + _LENGTH_AT)[0]
            offsets.append(at)
    except (struct.error, OverflowError):  # a length leads out of the file
        return None
    return offsets if at == len(data) else None


def _checked_offsets(reader: RecordReader) -> list[int]:
    """The same, step by step, with a word on the record that is wrong."""
    data, end = reader.data, len(reader.data)
    offsets, at = [COUNT.size], COUNT.size
    for _ in reader.records("point", POINT_HEAD.itemsize):
        if at + POINT_HEAD.itemsize > end:
            raise reader.ends()
        (length,) = COUNT.unpack_from(data, at + _LENGTH_AT)
        at += POINT_HEAD.itemsize + _TRACK_BYTES * length
        if at > end:
            reader.parts = f"{length} observations"
            raise reader.ends()
        offsets.append(at)
        reader.at = at
    return offsets


def _gather_points(
    data: bytes, offsets: NDArray[np.int64], lengths: NDArray[np.int64]
) -> PointRecords:
    """Copy the records at ``offsets`` out of the file, in the order of the point ids."""
    heads = _at_every_byte(data, POINT_HEAD)[offsets]
    if (heads["id"][1:] < heads["id"][:-1]).any():
        order = np.argsort(heads["id"], kind="stable")
        heads, offsets, lengths = heads[order], offsets[order], lengths[order]
    ids = heads["id"]
    if (ids[1:] == ids[:-1]).any():
        raise RecordError(f"point id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    if len(ids) and ids[-1] > np.iinfo(np.int64).max:
        raise RecordError(f"point id {ids[-1]}, more than 63 bits")
    start = np.concatenate([[0], np.cumsum(lengths)])
    # Observation j of point i begins start[i] pairs after the first one of the point.
    first = offsets + POINT_HEAD.itemsize - _TRACK_BYTES * start[:-1]
    at = np.repeat(first, lengths) + _TRACK_BYTES * np.arange(start[-1])
    tracks = _at_every_byte(data, np.dtype("<i8"))[at].view("<i4").reshape(-1, 2)
    return PointRecords(heads, start, tracks)


def _at_every_byte(data: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    """A view of the values that begin at each byte; one index takes records out of it."""
    count = max(0, len(data) - dtype.itemsize + 1)
    return np.ndarray((count,), dtype, data, strides=(1,))
