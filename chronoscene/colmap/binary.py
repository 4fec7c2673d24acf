"""Bulk reading of COLMAP's binary files with plain numpy.

Two reasons for a reader beside pycolmap: pycolmap gives points and observations one Python object
at a time (seconds for a scene of half a million points), and it does not notice that a file ends
early. Every length is checked against the size of the file before it is used. Nothing else is
checked, and nothing dropped: ids may be duplicated, names may not be valid text.

Records are little endian; a count comes first (u64). Camera: u32 id, i32 model, u64 width, u64
height, f64 parameters. Image: u32 id, f64 quaternion wxyz, f64 translation, u32 camera, name ended
by a zero byte, u64 n, then n times (f64 x, f64 y, i64 point id or -1). Point: u64 id, f64 xyz, u8
rgb, f64 error, u64 n, then n times (u32 image id, i32 keypoint index). Rig: u32 id, u32 number
of sensors, of the first its i32 type and u32 id, of each other one also u8 and, if that is set, a
pose (7 f64). Frame: u32 id, u32 rig, 7 f64, u32 n, then n times (i32 sensor type, u32 sensor id,
u64 image id).
"""

from __future__ import annotations

import struct
from bisect import bisect_right
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Ints
from chronoscene.colmap.raw_model import (
    IDENTITY,
    Pose,
    RawFrame,
    RawImages,
    RawPoints,
    RawRigs,
    Sensor,
)
from chronoscene.errors import SceneError
from chronoscene.io.documents import plain_file
from chronoscene.scene.cameras import CAMERA_MODELS, MODEL_NAMES, Camera

KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])  # A keypoint of an image
OBSERVATION = np.dtype([("image", "<u4"), ("keypoint", "<i4")])  # An element of a track
POINT_HEAD = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""Fields of a point before its track."""

_COUNT = struct.Struct("<Q")
_CAMERA_HEAD, _IMAGE_HEAD = struct.Struct("<IiQQ"), struct.Struct("<I7dI")
_LENGTH_AT = POINT_HEAD.itemsize - _COUNT.size
_TRACK_BYTES = OBSERVATION.itemsize
_U32, _U32_PAIR, _FLAG = struct.Struct("<I"), struct.Struct("<II"), struct.Struct("<B")
_SENSOR, _POSE = struct.Struct("<iI"), struct.Struct("<7d")


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Cameras in the order of ``cameras.bin``.

    Raises:
        SceneError: If the file cannot be read, ends inside a record, or has an unknown model.
    """
    cameras = []
    with _records_of(path) as reader:
        for _ in reader.records("camera", _CAMERA_HEAD.size):
            camera_id, model, width, height = reader.unpack(_CAMERA_HEAD)
            if not 0 <= model < len(MODEL_NAMES):
                found = f"the unknown model id {model} for camera {camera_id}"
                raise _RecordError(f"{found}, not 0..{len(MODEL_NAMES) - 1}")
            name = MODEL_NAMES[model]
            params = reader.unpack(struct.Struct(f"<{len(CAMERA_MODELS[name].params)}d"))
            cameras.append(Camera(camera_id, name, width, height, params))
    return tuple(cameras)


def read_images(path: Path) -> RawImages:
    """Images in the order of ``images.bin``.

    Raises:
        SceneError: If the file cannot be read or ends inside a record.
    """
    heads, names, lengths, keypoints = [], [], [], []
    with _records_of(path) as reader:
        whole = memoryview(reader.data)
        for _ in reader.records("image", _IMAGE_HEAD.size + 1 + _COUNT.size):
            heads.append(reader.unpack(_IMAGE_HEAD))
            names.append(reader.text().decode("utf-8", "surrogateescape"))
            (length,) = reader.unpack(_COUNT)
            reader.parts = f"{length} keypoints"
            begin = reader.skip(length * KEYPOINT.itemsize)
            lengths.append(length)
            keypoints.append(whole[begin : reader.at])
    table = np.array(heads, np.float64).reshape(-1, 9)  # ids of 32 bits are exact
    records = np.frombuffer(b"".join(keypoints), KEYPOINT)
    return RawImages(
        ids=table[:, 0].astype(np.int64),
        names=tuple(names),
        quaternions=np.ascontiguousarray(table[:, 1:5]),
        translations=np.ascontiguousarray(table[:, 5:8]),
        camera_ids=table[:, 8].astype(np.int64),
        keypoint_start=np.cumsum([0, *lengths]),
        keypoint_xy=np.ascontiguousarray(records["xy"]),
        keypoint_point=np.ascontiguousarray(records["point_id"]),
    )


def read_points(path: Path) -> RawPoints:
    """Points of ``points3D.bin``, sorted by id.

    Raises:
        SceneError: If the file cannot be read, ends inside a record, or has duplicate ids.
    """
    with _records_of(path) as reader:
        # One step per record, as each states only its own length; all else in whole columns.
        begin = np.array(_point_offsets(reader), np.int64)
        lengths = (np.diff(begin) - POINT_HEAD.itemsize) // _TRACK_BYTES
        return _gather_points(reader.data, begin[:-1], lengths)


def read_rigs(folder: Path) -> RawRigs | None:
    """``rigs.bin`` and ``frames.bin``; None where one is absent, as in models before COLMAP 3.12.

    Raises:
        SceneError: If a file cannot be read or ends inside a record.
    """
    rigs, frames = folder / "rigs.bin", folder / "frames.bin"
    found = _read_rigs(rigs) if rigs.exists() else None
    posed = _read_frames(frames) if frames.exists() else None
    return None if found is None or posed is None else RawRigs(found, posed)


class _RecordError(Exception):
    """Problem of a record."""


class _Reader:
    """Reader of a file from start to end; errors name the record in which it ends."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0
        """Bytes read so far."""
        self.index: int | None = None
        """Index of the current record; None before the first."""
        self.kind = ""
        self.parts = ""
        """Number of parts that the current record announces, for messages."""

    def records(self, kind: str, min_size: int) -> Iterator[None]:
        """Iterate over the records; the caller reads each before it asks for the next."""
        count = self.start(kind, min_size)
        for self.index in range(count):
            self.parts = ""
            yield
        self.finish()

    def start(self, kind: str, min_size: int) -> int:
        """Read the number of records of at least ``min_size`` bytes; refuse more than fit."""
        (count,) = self.unpack(_COUNT)
        if count * min_size > len(self.data) - self.at:
            raise _RecordError(f"{count} records announced in {len(self.data)} bytes")
        self.kind = kind
        return int(count)

    def finish(self) -> None:
        """Refuse bytes after the last record."""
        if self.at != len(self.data):
            raise _RecordError(f"{len(self.data) - self.at} bytes after the last record")

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """Read the next values of a layout."""
        return layout.unpack_from(self.data, self.skip(layout.size))

    def skip(self, size: int) -> int:
        """Skip ``size`` bytes, which must exist; returns where they begin."""
        begin = self.at
        if size > len(self.data) - begin:
            raise self.ends()
        self.at += size
        return begin

    def text(self) -> bytes:
        """Read up to the next zero byte, which is skipped."""
        begin, end = self.at, self.data.find(b"\0", self.at)
        if end < 0:
            raise self.ends()
        self.at = end + 1
        return self.data[begin:end]

    def ends(self) -> _RecordError:
        """Error for a file that ends too early."""
        if self.index is None:
            return _RecordError("a file that ends inside the number of its records")
        announced = f", which announces {self.parts}" if self.parts else ""
        return _RecordError(f"a file that ends inside {self.kind} record {self.index}{announced}")


@contextmanager
def _records_of(path: Path) -> Iterator[_Reader]:
    """Open a file to read its records; errors name the path."""
    try:
        yield _Reader(plain_file(path).read_bytes())
        return
    except OSError as error:
        found = error.strerror or "unreadable"
    except _RecordError as error:
        found = str(error)
    raise SceneError(
        path,
        expected="complete COLMAP records",
        found=found,
        todo="copy the file again or write the model again with COLMAP",
    )


def _read_rigs(path: Path) -> dict[int, dict[Sensor, Pose | None]]:
    rigs = {}
    with _records_of(path) as reader:
        for _ in reader.records("rig", _U32_PAIR.size):
            rig_id, count = reader.unpack(_U32_PAIR)
            reader.parts = f"{count} sensors"
            sensors: dict[Sensor, Pose | None] = {}
            if count:
                sensors[_sensor(reader)] = IDENTITY
            for _ in range(count - 1):
                sensor = _sensor(reader)
                (known,) = reader.unpack(_FLAG)
                sensors[sensor] = reader.unpack(_POSE) if known else None
            rigs[rig_id] = sensors
    return rigs


def _read_frames(path: Path) -> tuple[RawFrame, ...]:
    frames = []
    with _records_of(path) as reader:
        for _ in reader.records("frame", _U32_PAIR.size + _POSE.size + _U32.size):
            frame_id, rig_id = reader.unpack(_U32_PAIR)
            pose = reader.unpack(_POSE)
            (count,) = reader.unpack(_U32)
            reader.parts = f"{count} images"
            data = tuple((_sensor(reader), reader.unpack(_COUNT)[0]) for _ in range(count))
            frames.append(RawFrame(frame_id, rig_id, pose, data))
    return tuple(frames)


def _sensor(reader: _Reader) -> Sensor:
    kind, sensor_id = reader.unpack(_SENSOR)
    return kind, sensor_id


def _point_offsets(reader: _Reader) -> list[int]:
    """Offsets of the records, and of the end of the last."""
    count = reader.start("point", POINT_HEAD.itemsize)
    data, end, at = reader.data, len(reader.data), reader.at
    unpack, head, offsets = _COUNT.unpack_from, POINT_HEAD.itemsize, [at]
    try:
        for _ in range(count):
            at += head + _TRACK_BYTES * unpack(data, at + _LENGTH_AT)[0]
            offsets.append(at)
    except (struct.error, OverflowError):
        pass  # beyond the end of the file
    if len(offsets) <= count or at > end:
        reader.index = bisect_right(offsets, end) - 1
        begin = offsets[reader.index]
        if begin + head <= end:
            reader.parts = f"{unpack(data, begin + _LENGTH_AT)[0]} observations"
        raise reader.ends()
    reader.at = at
    reader.finish()
    return offsets


def _gather_points(data: bytes, offsets: Ints, lengths: Ints) -> RawPoints:
    """Copy the records at ``offsets`` out of the file, in the order of the point ids."""
    heads = _at_every_byte(data, POINT_HEAD)[offsets]
    if (heads["id"][1:] < heads["id"][:-1]).any():
        order = np.argsort(heads["id"], kind="stable")
        heads, offsets, lengths = heads[order], offsets[order], lengths[order]
    ids = heads["id"]
    if (ids[1:] == ids[:-1]).any():
        raise _RecordError(f"point id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    if len(ids) and ids[-1] > np.iinfo(np.int64).max:
        raise _RecordError(f"point id {ids[-1]}, more than 63 bits")
    start = np.concatenate([[0], np.cumsum(lengths)])
    # Observation j of point i begins start[i] pairs after the first one of the point.
    first = offsets + POINT_HEAD.itemsize - _TRACK_BYTES * start[:-1]
    at = np.repeat(first, lengths) + _TRACK_BYTES * np.arange(start[-1])
    tracks = _at_every_byte(data, np.dtype("<i8"))[at].view(OBSERVATION)
    return RawPoints(
        ids=ids.astype(np.int64),
        xyz=np.ascontiguousarray(heads["xyz"]),
        rgb=np.ascontiguousarray(heads["rgb"]),
        error=np.ascontiguousarray(heads["error"]),
        track_start=start,
        track_image=tracks["image"].astype(np.int64),
        track_keypoint=tracks["keypoint"].astype(np.int64),
    )


def _at_every_byte(data: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    """View of the values that begin at each byte; indexing it takes out records."""
    count = max(0, len(data) - dtype.itemsize + 1)
    return np.ndarray((count,), dtype, data, strides=(1,))
