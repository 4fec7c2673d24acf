"""Binary ``cameras.bin`` and ``images.bin``, record by record.

The records are described in `chronoscene.colmap_records`, whose reader of points is used as it is;
of images more is needed here than a scene keeps (names, poses and point ids as stored).
"""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from chronoscene.colmap_records import CAMERA_PARAMETERS
from chronoscene.scene import Camera
from chronoscene.validation.raw_model import CAMERA_MODELS, Damage, DamagedError, RawImages

_COUNT = struct.Struct("<Q")
_CAMERA = struct.Struct("<iiQQ")
_IMAGE = struct.Struct("<i7di")
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point_id", "<i8")])


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Cameras in the order of the file.

    Raises:
        DamagedError: If the file ends inside a record, goes on after the last, or has an unknown
            camera model.
    """
    data = path.read_bytes()
    cameras = []
    at = _COUNT.size
    for i in range(_read_count(path, data, _CAMERA.size)):
        if at + _CAMERA.size > len(data):
            raise _ends(path, f"camera record {i}")
        camera_id, model, width, height = _CAMERA.unpack_from(data, at)
        at += _CAMERA.size
        if not 0 <= model < len(CAMERA_MODELS):
            known = f"0..{len(CAMERA_MODELS) - 1}"
            raise _damaged(path, f"a model id {known}", f"{model} for camera {camera_id}")
        count = CAMERA_PARAMETERS[model]
        if at + 8 * count > len(data):
            raise _ends(path, f"camera record {i}")
        params = struct.unpack_from(f"<{count}d", data, at)
        cameras.append(Camera(camera_id, CAMERA_MODELS[model], width, height, params))
        at += 8 * count
    _check_end(path, data, at)
    return tuple(cameras)


def read_images(path: Path) -> RawImages:
    """Images in the order of the file.

    Raises:
        DamagedError: If the file ends inside a record or goes on after the last.
    """
    data = path.read_bytes()
    heads, names, keypoints = [], [], []
    at = _COUNT.size
    for i in range(_read_count(path, data, _IMAGE.size + 1 + _COUNT.size)):
        name_end = data.find(b"\0", at + _IMAGE.size)
        if name_end < 0 or name_end + 1 + _COUNT.size > len(data):
            raise _ends(path, f"image record {i}")
        heads.append(_IMAGE.unpack_from(data, at))
        names.append(data[at + _IMAGE.size : name_end].decode("utf-8", "surrogateescape"))
        at = name_end + 1
        (length,) = _COUNT.unpack_from(data, at)
        at += _COUNT.size
        if length * _KEYPOINT.itemsize > len(data) - at:
            raise _ends(path, f"image record {i}, which announces {length} keypoints")
        keypoints.append(np.frombuffer(data, _KEYPOINT, length, at))
        at += length * _KEYPOINT.itemsize
    _check_end(path, data, at)
    table = np.array(heads, np.float64).reshape(-1, 9)
    merged = np.concatenate([np.zeros(0, _KEYPOINT), *keypoints])
    return RawImages(
        ids=table[:, 0].astype(np.int64),
        names=tuple(names),
        quaternions=table[:, 1:5],
        translations=table[:, 5:8],
        camera_ids=table[:, 8].astype(np.int64),
        keypoint_start=np.cumsum([0, *map(len, keypoints)]),
        keypoint_xy=np.ascontiguousarray(merged["xy"]),
        keypoint_point=np.ascontiguousarray(merged["point_id"]),
    )


def _read_count(path: Path, data: bytes, smallest_record: int) -> int:
    """The leading count, refused if so many records cannot fit into the file."""
    if len(data) < _COUNT.size:
        raise _damaged(path, "complete COLMAP records", f"a file of {len(data)} bytes")
    (count,) = _COUNT.unpack_from(data, 0)
    if count * smallest_record > len(data) - _COUNT.size:
        found = f"{count} records announced in {len(data)} bytes"
        raise _damaged(path, "complete COLMAP records", found)
    return int(count)


def _check_end(path: Path, data: bytes, at: int) -> None:
    if at != len(data):
        found = f"{len(data) - at} bytes after the last record"
        raise _damaged(path, "complete COLMAP records and nothing else", found)


def _ends(path: Path, record: str) -> DamagedError:
    return _damaged(path, "complete COLMAP records", f"a file that ends inside {record}")


def _damaged(path: Path, expected: str, found: str) -> DamagedError:
    return DamagedError(Damage(path.name, expected, found))
