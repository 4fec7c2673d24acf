"""Poses that are the same to the last bit in a model that was written anew.

Reading a pose as a matrix and writing it as a quaternion may change its last bits. So the numbers
of the old file are copied over those of the new one, in ``images.bin`` and in ``frames.bin``.
"""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path

from chronoscene.colmap.binary import read_images
from chronoscene.colmap.model import model_kind, read_reconstruction
from chronoscene.io.files import replacing

_POSE_BYTES = 7 * 8
_KEYPOINT_BYTES = 24
_FRAME_HEAD = 8
_FRAME_IMAGE = struct.Struct("<iIQ")


def pose_bytes(folder: Path) -> dict[str, bytes]:
    """Quaternion and translation of each image of a model, as they stand in ``images.bin``."""
    if model_kind(folder) == "binary":
        records = read_images(folder / "images.bin")
    else:
        with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
            read_reconstruction(folder).write_binary(temporary)
            records = read_images(Path(temporary) / "images.bin")
    return {
        record.name.decode(): struct.pack("<7d", *record.quaternion, *record.translation)
        for record in records
    }


def copy_poses(poses: dict[str, bytes], folder: Path) -> int:
    """Put poses into a binary model by image name; the number of images that got one."""
    by_id: dict[int, bytes] = {}
    path = folder / "images.bin"
    data = bytearray(path.read_bytes())
    at = 8
    for _ in range(struct.unpack_from("<Q", data, 0)[0]):
        (image_id,) = struct.unpack_from("<i", data, at)
        start = at + 4
        end = data.index(b"\0", start + _POSE_BYTES + 4)
        name = data[start + _POSE_BYTES + 4 : end].decode()
        if name in poses:
            data[start : start + _POSE_BYTES] = by_id[image_id] = poses[name]
        (count,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9 + _KEYPOINT_BYTES * count
    with replacing(path) as partial:
        partial.write_bytes(data)
    _copy_to_frames(by_id, folder / "frames.bin")
    return len(by_id)


def _copy_to_frames(by_id: dict[int, bytes], path: Path) -> None:
    """The same for frames of one image each, whose pose is that of the image."""
    if not path.exists():
        return
    data = bytearray(path.read_bytes())
    at = 8
    for _ in range(struct.unpack_from("<Q", data, 0)[0]):
        start = at + _FRAME_HEAD
        (count,) = struct.unpack_from("<I", data, start + _POSE_BYTES)
        at = start + _POSE_BYTES + 4
        images = [_FRAME_IMAGE.unpack_from(data, at + 16 * i)[2] for i in range(count)]
        at += 16 * count
        if len(images) == 1 and images[0] in by_id:
            data[start : start + _POSE_BYTES] = by_id[images[0]]
    with replacing(path) as partial:
        partial.write_bytes(data)
