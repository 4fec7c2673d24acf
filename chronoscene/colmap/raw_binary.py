"""The binary records of `chronoscene.colmap.binary` as the parts of a raw model.

Nothing is dropped: ids may come twice, names may be no text. Every reader raises SceneError if its
file cannot be read or ends inside a record.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from chronoscene.colmap import binary as colmap_records
from chronoscene.colmap.arrays import RawImages, RawPoints
from chronoscene.scene.cameras import MODEL_NAMES, Camera


def read_cameras(path: Path) -> tuple[Camera, ...]:
    """Cameras in the order of the file."""
    return tuple(
        Camera(r.camera_id, MODEL_NAMES[r.model_id], r.width, r.height, r.params)
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
    records = colmap_records.read_points(path)
    heads = records.heads
    return RawPoints(
        ids=heads["id"].astype(np.int64),
        xyz=np.ascontiguousarray(heads["xyz"]),
        rgb=np.ascontiguousarray(heads["rgb"]),
        error=np.ascontiguousarray(heads["error"]),
        track_start=records.track_start,
        track_image=records.tracks[:, 0].astype(np.int64),
        track_keypoint=records.tracks[:, 1].astype(np.int64),
    )
