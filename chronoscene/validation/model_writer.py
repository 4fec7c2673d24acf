"""Raw models back to COLMAP's binary files, with nothing checked: what is broken stays broken."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from chronoscene.scene import Camera
from chronoscene.validation.raw_binary import POINT_HEAD
from chronoscene.validation.raw_model import CAMERA_MODELS, RawImages, RawPoints

_COUNT = struct.Struct("<Q")
_CAMERA, _IMAGE = struct.Struct("<IIQQ"), struct.Struct("<I7dI")
_KEYPOINT = np.dtype([("xy", "<f8", 2), ("point", "<i8")])
_PAIR = np.dtype("<i4")
_ID = 0xFFFFFFFF
"""Ids have 32 bits; which of them are negative is a matter of the reader."""


def write_raw_model(
    folder: Path, cameras: Sequence[Camera], images: RawImages, points: RawPoints
) -> None:
    """Write the three files into an existing folder.

    Raises:
        struct.error, OverflowError: If a number does not fit into its field.
    """
    (folder / "cameras.bin").write_bytes(_cameras(cameras))
    (folder / "images.bin").write_bytes(_images(images))
    (folder / "points3D.bin").write_bytes(_points(points))


def _cameras(cameras: Sequence[Camera]) -> bytes:
    parts = [_COUNT.pack(len(cameras))]
    for c in cameras:
        model = CAMERA_MODELS.index(c.model)
        parts.append(_CAMERA.pack(c.camera_id & _ID, model, c.width, c.height))
        parts.append(struct.pack(f"<{len(c.params)}d", *c.params))
    return b"".join(parts)


def _images(images: RawImages) -> bytes:
    keypoints = np.empty(len(images.keypoint_point), _KEYPOINT)
    keypoints["xy"], keypoints["point"] = images.keypoint_xy, images.keypoint_point
    parts = [_COUNT.pack(len(images))]
    poses = np.concatenate([images.quaternions, images.translations], axis=1).tolist()
    for i, pose in enumerate(poses):
        begin, end = images.keypoint_start[i : i + 2].tolist()
        ids = int(images.ids[i]) & _ID, int(images.camera_ids[i]) & _ID
        parts.append(_IMAGE.pack(ids[0], *pose, ids[1]))
        parts.append(images.names[i].encode("utf-8", "surrogateescape") + b"\0")
        parts.append(_COUNT.pack(end - begin))
        parts.append(keypoints[begin:end].tobytes())
    return b"".join(parts)


def _points(points: RawPoints) -> bytes:
    """Heads and tracks are scattered into the file as whole columns."""
    lengths = np.diff(points.track_start)
    heads = np.empty(len(points), POINT_HEAD)
    heads["id"], heads["xyz"], heads["rgb"] = points.ids, points.xyz, points.rgb
    heads["error"], heads["length"] = points.error, lengths
    pairs = np.empty((len(points.track_image), 2), _PAIR)
    pairs[:, 0], pairs[:, 1] = points.track_image, points.track_keypoint
    is_head = np.ones(2 * len(points), bool)
    is_head[1::2] = False
    sizes = np.empty(2 * len(points), np.int64)
    sizes[0::2], sizes[1::2] = POINT_HEAD.itemsize, lengths * 2 * _PAIR.itemsize
    data = np.empty(int(sizes.sum()), np.uint8)
    mask = np.repeat(is_head, sizes)
    data[mask] = heads.view(np.uint8).ravel()
    data[~mask] = pairs.view(np.uint8).ravel()
    return _COUNT.pack(len(points)) + data.tobytes()
