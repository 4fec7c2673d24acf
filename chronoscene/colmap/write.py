"""Bulk writing of COLMAP's binary files: seconds less per scene than one object at a time.

`chronoscene.colmap.binary` describes the records, and reads them.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from chronoscene.arrays import Array, Ints
from chronoscene.colmap.binary import KEYPOINT, OBSERVATION, POINT_HEAD
from chronoscene.colmap.raw_model import RawImages, RawPoints
from chronoscene.scene.cameras import MODEL_NAMES, Camera
from chronoscene.scene.geometry import quaternion_from_rotation

_COUNT = struct.Struct("<Q")
_CAMERA, _IMAGE = struct.Struct("<IIQQ"), struct.Struct("<I7dI")


def write_raw_model(
    folder: Path, cameras: Sequence[Camera], images: RawImages, points: RawPoints
) -> None:
    """Write the three files into an existing folder. Nothing is checked or repaired.

    Raises:
        struct.error, OverflowError: If a number does not fit into its field.
    """
    (folder / "cameras.bin").write_bytes(_cameras(cameras))
    (folder / "images.bin").write_bytes(_images(images))
    (folder / "points3D.bin").write_bytes(_points(points))


def write_without_observations(source: Path, images: RawImages, folder: Path) -> None:
    """Write the binary model ``source``, which has ``images``, without keypoints and points.

    pycolmap reads it in a fraction of the time.
    """
    for file in ("cameras.bin", "rigs.bin", "frames.bin"):
        if (source / file).is_file():
            shutil.copyfile(source / file, folder / file)
    bare = replace(
        images,
        keypoint_start=np.zeros(len(images) + 1, np.int64),
        keypoint_xy=np.zeros((0, 2)),
        keypoint_point=np.zeros(0, np.int64),
    )
    (folder / "images.bin").write_bytes(_images(bare))
    (folder / "points3D.bin").write_bytes(_COUNT.pack(0))


def posed_images(
    ids: Ints,
    names: Sequence[str],
    poses: Array,
    camera_ids: Ints,
    observations: tuple[Ints, Ints, Array],
) -> tuple[RawImages, Ints]:
    """Make images whose keypoints are the given observations, in their order.

    Args:
        ids: [I]
        names: I of them.
        poses: World to camera. [I, 4, 4]
        camera_ids: [I]
        observations: Row of the image [M], id of the point [M], and pixels [M, 2] of each.

    Returns:
        images: As `write_raw_model` takes them.
        keypoints: Index of each observation in its image. [M]
    """
    rows, points, xy = observations
    order = np.argsort(rows, kind="stable")
    start = np.searchsorted(rows[order], np.arange(len(names) + 1))
    keypoints = np.empty(len(order), np.int64)
    keypoints[order] = np.arange(len(order)) - start[rows[order]]
    quaternions = [quaternion_from_rotation(pose[:3, :3]) for pose in poses]
    images = RawImages(
        ids=ids,
        names=tuple(names),
        quaternions=np.array(quaternions, np.float64).reshape(-1, 4),
        translations=poses[:, :3, 3],
        camera_ids=camera_ids,
        keypoint_start=start,
        keypoint_xy=xy[order],
        keypoint_point=points[order],
    )
    return images, keypoints


def _cameras(cameras: Sequence[Camera]) -> bytes:
    parts = [_COUNT.pack(len(cameras))]
    for c in cameras:
        model = MODEL_NAMES.index(c.model)
        parts.append(_CAMERA.pack(c.camera_id, model, c.width, c.height))
        parts.append(struct.pack(f"<{len(c.params)}d", *c.params))
    return b"".join(parts)


def _images(images: RawImages) -> bytes:
    keypoints = np.empty(len(images.keypoint_point), KEYPOINT)
    keypoints["xy"], keypoints["point_id"] = images.keypoint_xy, images.keypoint_point
    parts = [_COUNT.pack(len(images))]
    poses = np.concatenate([images.quaternions, images.translations], axis=1).tolist()
    for i, pose in enumerate(poses):
        begin, end = images.keypoint_start[i : i + 2].tolist()
        parts.append(_IMAGE.pack(int(images.ids[i]), *pose, int(images.camera_ids[i])))
        parts.append(images.names[i].encode("utf-8", "surrogateescape") + b"\0")
        parts.append(_COUNT.pack(end - begin))
        parts.append(keypoints[begin:end].tobytes())
    return b"".join(parts)


def _points(points: RawPoints) -> bytes:
    """Serialise points; heads and tracks are scattered into the file as whole columns."""
    lengths = np.diff(points.track_start)
    heads = np.empty(len(points), POINT_HEAD)
    heads["id"], heads["xyz"], heads["rgb"] = points.ids, points.xyz, points.rgb
    heads["error"], heads["length"] = points.error, lengths
    tracks = np.empty(len(points.track_image), OBSERVATION)
    tracks["image"], tracks["keypoint"] = points.track_image, points.track_keypoint
    head_sizes = np.full_like(lengths, POINT_HEAD.itemsize)
    sizes = np.column_stack([head_sizes, lengths * OBSERVATION.itemsize]).ravel()
    data = np.empty(int(sizes.sum()), np.uint8)
    mask = np.repeat(np.tile([True, False], len(points)), sizes)
    data[mask] = heads.view(np.uint8).ravel()
    data[~mask] = tracks.view(np.uint8).ravel()
    return _COUNT.pack(len(points)) + data.tobytes()
