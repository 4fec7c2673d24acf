"""``rigs`` and ``frames``, which COLMAP writes beside the three classic files since 3.12.

A rig says how sensors are mounted on each other, a frame where a rig was when its images were
taken. Binary records are as in `chronoscene.colmap.binary`; in text, fields are separated by
blanks, and a sensor is ``CAMERA <id>``.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.colmap.record_reader import RecordReader, read_records
from chronoscene.errors import SceneError
from chronoscene.scene.geometry import rotation_from_quaternion

Pose = tuple[float, ...]
"""Quaternion wxyz and translation."""

IDENTITY: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
CAMERA = 0
"""Type of the sensors that are cameras."""

Sensor = tuple[int, int]
"""Type and id."""

Fields = deque[str]
"""Of a line of text; they are taken from the left."""

_U32_PAIR, _SENSOR, _POSE = struct.Struct("<II"), struct.Struct("<iI"), struct.Struct("<7d")
_FLAG, _COUNT, _DATA_ID = struct.Struct("<B"), struct.Struct("<I"), struct.Struct("<Q")


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame."""

    frame_id: int
    rig_id: int
    rig_from_world: Pose
    data: tuple[tuple[Sensor, int], ...]
    """Sensors, and the ids of what they took: of cameras, image ids."""


@dataclass(frozen=True, slots=True)
class RawRigs:
    """Rigs and frames as the files have them."""

    rigs: dict[int, dict[Sensor, Pose | None]]
    """By rig id, the poses of its sensors (``sensor_from_rig``), None if not known."""
    frames: tuple[RawFrame, ...]


def read_rigs(folder: Path, form: str) -> RawRigs | None:
    """Both files of one form (``.bin`` or ``.txt``), or None if either cannot be read."""
    rigs, frames = folder / f"rigs{form}", folder / f"frames{form}"
    if not (rigs.is_file() and frames.is_file()):
        return None
    try:
        if form == ".bin":
            return RawRigs(read_records(rigs, _walk_rigs), read_records(frames, _walk_frames))
        return RawRigs(dict(map(_rig, _lines(rigs))), tuple(map(_frame, _lines(frames))))
    except (OSError, SceneError, ValueError, IndexError, OverflowError):
        return None  # damaged: the rule on damaged files, or COLMAP itself, says so


def pose_matrices(poses: ArrayLike) -> NDArray[np.float64]:
    """``[R t; 0 1]`` of poses, each 7 numbers; not finite where the pose is not. [n, 4, 4]"""
    values = np.asarray(poses, np.float64).reshape(-1, 7)
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    matrices[:, :3, :3] = rotation_from_quaternion(values[:, :4])
    matrices[:, :3, 3] = values[:, 4:]
    return matrices


def _walk_rigs(reader: RecordReader) -> dict[int, dict[Sensor, Pose | None]]:
    rigs = {}
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


def _walk_frames(reader: RecordReader) -> tuple[RawFrame, ...]:
    frames = []
    for _ in reader.records("frame", _U32_PAIR.size + _POSE.size + _COUNT.size):
        frame_id, rig_id = reader.unpack(_U32_PAIR)
        pose = reader.unpack(_POSE)
        (count,) = reader.unpack(_COUNT)
        reader.parts = f"{count} images"
        data = tuple((_sensor(reader), reader.unpack(_DATA_ID)[0]) for _ in range(count))
        frames.append(RawFrame(frame_id, rig_id, pose, data))
    return tuple(frames)


def _sensor(reader: RecordReader) -> Sensor:
    kind, sensor_id = reader.unpack(_SENSOR)
    return kind, sensor_id


def _lines(path: Path) -> Iterator[Fields]:
    """Fields of the lines that are no comments."""
    for line in path.read_text(encoding="utf-8").split("\n"):
        if line.strip() and not line.lstrip().startswith("#"):
            yield deque(line.split())


def _rig(fields: Fields) -> tuple[int, dict[Sensor, Pose | None]]:
    rig_id, count = int(fields.popleft()), int(fields.popleft())
    sensors: dict[Sensor, Pose | None] = {}
    if count > 0:
        sensors[_text_sensor(fields)] = IDENTITY
    for _ in range(count - 1):  # ends with the fields
        sensor, known = _text_sensor(fields), int(fields.popleft())
        sensors[sensor] = _text_pose(fields) if known else None
    return rig_id, sensors


def _frame(fields: Fields) -> RawFrame:
    frame_id, rig_id = int(fields.popleft()), int(fields.popleft())
    pose, count = _text_pose(fields), int(fields.popleft())
    data = [(_text_sensor(fields), int(fields.popleft())) for _ in range(count)]
    return RawFrame(frame_id, rig_id, pose, tuple(data))


def _text_pose(fields: Fields) -> Pose:
    return tuple(float(fields.popleft()) for _ in range(7))


def _text_sensor(fields: Fields) -> Sensor:
    kind = fields.popleft()
    return (CAMERA if kind == "CAMERA" else 1), int(fields.popleft())
