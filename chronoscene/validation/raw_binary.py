"""The binary records of `chronoscene.colmap_records` as the parts of a raw model.

Nothing is dropped: ids may come twice, names may be no text. Every reader raises SceneError if its
file cannot be read or ends inside a record.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene import colmap_records
from chronoscene.record_reader import COUNT, RecordError, RecordReader, read_records
from chronoscene.scene import Camera
from chronoscene.validation.raw_model import CAMERA_MODELS, RawImages, RawPoints

POINT_HEAD = np.dtype(
    [("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("length", "<u8")]
)
"""What stands before the track of a point."""

_LENGTH_AT = POINT_HEAD.itemsize - COUNT.size
_PAIR = 8
"""Bytes of one observation in a track: image id and keypoint index."""


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Cameras in the order of the file."""
    return tuple(
        Camera(r.camera_id, CAMERA_MODELS[r.model_id], r.width, r.height, r.params)
        for r in colmap_records.read_cameras(path)
    )


def read_images(path: Path) -> RawImages:
    """Images in the order of the file."""
    records = colmap_records.read_images(path)
    return RawImages(
        ids=np.array([r.image_id for r in records], np.int64),
        names=tuple(r.name.decode("utf-8", "surrogateescape") for r in records),
        quaternions=np.array([r.quaternion for r in records], np.float64).reshape(-1, 4),
        translations=np.array([r.translation for r in records], np.float64).reshape(-1, 3),
        camera_ids=np.array([r.camera_id for r in records], np.int64),
        keypoint_start=np.cumsum([0, *(len(r.xy) for r in records)]),
        keypoint_xy=np.concatenate([np.zeros((0, 2)), *(r.xy for r in records)]),
        keypoint_point=np.concatenate([np.zeros(0, np.int64), *(r.point_ids for r in records)]),
    )


def read_points(path: Path) -> RawPoints:
    """Points sorted by id."""
    return read_records(path, _walk_points)


def _walk_points(reader: RecordReader) -> RawPoints:
    """One loop over the lengths of the records; all else in whole columns.

    It says the same as `chronoscene.colmap_records.read_points`, several times as quickly.
    """
    data, unpack, end = reader.data, COUNT.unpack_from, len(reader.data)
    offsets, at = [COUNT.size], COUNT.size
    for _ in reader.records("point", POINT_HEAD.itemsize):
        if at + POINT_HEAD.itemsize > end:
            raise reader.ends()
        (length,) = unpack(data, at + _LENGTH_AT)
        at += POINT_HEAD.itemsize + _PAIR * length
        if at > end:
            reader.parts = f"{length} observations"
            raise reader.ends()
        offsets.append(at)
        reader.at = at
    begin = np.array(offsets, np.int64)
    return _gather(data, begin[:-1], (np.diff(begin) - POINT_HEAD.itemsize) // _PAIR)


def _gather(data: bytes, offsets: NDArray[np.int64], lengths: NDArray[np.int64]) -> RawPoints:
    """The records at ``offsets``, in the order of the point ids."""
    heads = _at_every_byte(data, POINT_HEAD)[offsets]
    order = np.argsort(heads["id"], kind="stable")
    ids = heads["id"][order]
    if (ids[1:] == ids[:-1]).any():
        raise RecordError(f"point id {ids[:-1][ids[1:] == ids[:-1]][0]} twice")
    if len(ids) and ids[-1] > np.iinfo(np.int64).max:
        raise RecordError(f"point id {ids[-1]}, more than 63 bits")
    start = np.concatenate([[0], np.cumsum(lengths[order])])
    # Observation j of point i begins start[i] pairs after the first one of the point.
    first = (offsets + POINT_HEAD.itemsize)[order] - _PAIR * start[:-1]
    at = np.repeat(first, lengths[order]) + _PAIR * np.arange(start[-1])
    pairs = _at_every_byte(data, np.dtype("<i8"))[at].view("<i4").reshape(-1, 2)
    return RawPoints(
        ids=ids.astype(np.int64),
        xyz=np.ascontiguousarray(heads["xyz"][order]),
        rgb=np.ascontiguousarray(heads["rgb"][order]),
        error=np.ascontiguousarray(heads["error"][order]),
        track_start=start,
        track_image=pairs[:, 0].astype(np.int64),
        track_keypoint=pairs[:, 1].astype(np.int64),
    )


def _at_every_byte(data: bytes, dtype: np.dtype[Any]) -> NDArray[Any]:
    """A view of the values that begin at each byte; one index takes records out of it."""
    count = max(0, len(data) - dtype.itemsize + 1)
    return np.ndarray((count,), dtype, data, strides=(1,))
