"""CS14: rigs and frames of COLMAP 3.12 and later."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.colmap.arrays import CAMERA, RawFrame
from chronoscene.io.wording import counted, shown
from chronoscene.scene.geometry import camera_centre, rotation_from_quaternion
from chronoscene.validation.checks.reprojection import good_poses
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

Array = NDArray[np.float64]

ANGLE = 1e-3
"""Radians between two statements of one pose that rounding in a text file cannot explain."""

SHIFT = 1e-3
"""The same for positions, as a share of the extent of the cameras."""

PLACE = "sparse/0"


@rule(
    "CS141",
    "rigs-partial",
    "error",
    what="Of `rigs` and `frames`, which belong together, one is missing.",
    remedy="copy the missing file, or delete the other one: without both, each image is its own "
    "frame",
    bad="`frames.bin` without `rigs.bin`",
    needs=("model",),
)
def rigs_partial(scene: RawScene) -> Iterator[Hit]:
    assert scene.model is not None
    form = _form(scene)
    present = [s for s in ("rigs", "frames") if (scene.model.folder / f"{s}{form}").is_file()]
    if len(present) == 1:
        missing = "frames" if present == ["rigs"] else "rigs"
        place = f"{scene.model_place or '.'}/{missing}{form}"
        yield Hit(place, f"the file that {present[0]}{form} belongs to", "none")


@rule(
    "CS142",
    "rigs-inconsistent",
    "error",
    what="Rigs, frames, cameras and images of the model refer to what does not exist, or an image "
    "is in no frame or in two.",
    remedy="write all five files again together, or delete rigs and frames: then each image is "
    "its own frame",
    bad="`frames.bin` of an earlier run, with images that `images.bin` does not have",
    needs=("cameras", "images"),
)
def rigs_inconsistent(scene: RawScene) -> Iterator[Hit]:
    raw = scene.model.rigs if scene.model else None
    if raw is None:
        return
    assert scene.images is not None and scene.cameras is not None
    place = f"{scene.model_place or '.'}/frames{_form(scene)}"
    cameras = {camera.camera_id for camera in scene.cameras}
    images = dict(zip(scene.images.ids.tolist(), scene.images.names, strict=True))
    camera_of = dict(zip(images, scene.images.camera_ids.tolist(), strict=False))
    taken = Counter(image for frame in raw.frames for image in _images(frame))
    problems = {
        "rigs over cameras of the model": {
            f"camera {i} of rig {rig}"
            for rig, sensors in raw.rigs.items()
            for kind, i in sensors
            if kind == CAMERA and i not in cameras
        },
        "frames of rigs that exist": {
            f"rig {f.rig_id} of frame {f.frame_id}" for f in raw.frames if f.rig_id not in raw.rigs
        },
        "frames with sensors of their rig": {
            f"sensor {sensor[1]} of frame {f.frame_id}"
            for f in raw.frames
            for sensor, _ in f.data
            if f.rig_id in raw.rigs and sensor not in raw.rigs[f.rig_id]
        },
        "frames with images of the model": {f"image {i}" for i in taken if i not in images},
        "each image in one frame": {
            f"{images[i]} in {counted(taken[i], 'frame')}" for i in images if taken[i] != 1
        },
        "images under their own camera": {
            images[i]
            for frame in raw.frames
            for sensor, i in frame.data
            if sensor[0] == CAMERA and camera_of.get(i, sensor[1]) != sensor[1]
        },
    }
    for expected, wrong in problems.items():
        if wrong:
            yield Hit(place, expected, shown(sorted(wrong)), count=len(wrong))


@rule(
    "CS143",
    "rig-pose-differs",
    "error",
    what="The pose of an image in `images` is not the one that its frame and rig give. COLMAP "
    "reads the frames, older readers read the images, so they see two different scenes.",
    remedy="write the model again with COLMAP, or delete rigs and frames if the poses in images "
    "are right",
    bad="poses transformed in `images.bin` only, `frames.bin` left as it was",
    needs=("images",),
)
def rig_pose_differs(scene: RawScene) -> Iterator[Hit]:
    raw, images = scene.model.rigs if scene.model else None, scene.images
    if raw is None or images is None or not len(images):
        return
    if scene.cameras is not None and any(rigs_inconsistent(scene)):
        return  # of another model altogether
    row = {image_id: i for i, image_id in enumerate(images.ids.tolist())}
    good = good_poses(images)
    triples = [
        (row[image_id], pose, frame.rig_from_world)
        for frame in raw.frames
        for sensor, image_id in frame.data
        if sensor[0] == CAMERA
        and (pose := raw.rigs.get(frame.rig_id, {}).get(sensor)) is not None
        and good[row.get(image_id, -1)]
        and image_id in row
    ]
    if not triples:
        return
    index = np.array([i for i, _, _ in triples])
    stored = np.concatenate([images.quaternions[index], images.translations[index]], axis=1)
    composed = pose_matrices([pose for _, pose, _ in triples]) @ pose_matrices(
        [rig_from_world for _, _, rig_from_world in triples]
    )
    extent = float(np.max(np.ptp(scene.centres[good], axis=0)))
    same = _same_pose(pose_matrices(stored), composed, extent)
    different = [images.names[i] for i in index[~same].tolist()]
    if different:
        found = f"another one for {counted(len(different), 'image')}: {shown(sorted(different))}"
        place = scene.model_file("images")
        yield Hit(place, "the poses of rigs and frames", found, count=len(different))


def pose_matrices(poses: ArrayLike) -> Array:
    """``[R t; 0 1]`` of poses, each 7 numbers; not finite where the pose is not. [n, 4, 4]"""
    values = np.asarray(poses, np.float64).reshape(-1, 7)
    matrices = np.tile(np.eye(4), (len(values), 1, 1))
    matrices[:, :3, :3] = rotation_from_quaternion(values[:, :4])
    matrices[:, :3, 3] = values[:, 4:]
    return matrices


def _same_pose(a: Array, b: Array, extent: float) -> NDArray[np.bool_]:
    """Of poses [n, 4, 4]; false, too, where one is not finite. [n]"""
    turned = np.linalg.norm(a[:, :3, :3] - b[:, :3, :3], axis=(1, 2))
    moved = np.linalg.norm(camera_centre(a) - camera_centre(b), axis=1)
    return np.asarray((turned <= 2 * ANGLE) & (moved <= SHIFT * extent + 1e-9))


def _images(frame: RawFrame) -> list[int]:
    return [image for (kind, _), image in frame.data if kind == CAMERA]


def _form(scene: RawScene) -> str:
    """The form of the model's files."""
    assert scene.model is not None
    return next(iter(scene.model.files.values()))[-4:]
