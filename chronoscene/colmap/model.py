"""COLMAP models to and from numpy.

pycolmap is the authority on cameras and poses (text and binary, models with and without rigs and
frames). Points and observations come from the binary records (`chronoscene.colmap.binary`) and are
checked here; pycolmap does not see those of binary models, which saves a third of the time. A text
model is rewritten as binary in a temporary folder first.
"""

from __future__ import annotations

import re
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.arrays import RawPoints
from chronoscene.colmap.binary import (
    ImageRecord,
    PointRecords,
    check_records,
    read_images,
    read_points,
)
from chronoscene.colmap.write import posed_images, write_raw_model, write_without_observations
from chronoscene.errors import SceneError
from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene import Camera, Frame, Points
from chronoscene.scene.cameras import from_pycolmap
from chronoscene.scene.geometry import pose_from_rotation_translation, rotation_from_quaternion

MODEL_FILES = ("cameras", "images", "points3D")
"""Stems of the files that every model has."""

UNIT = 1e-9
"""Deviation of the length of a quaternion from 1 that is rounding."""


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """A registered image of a model."""

    image_id: int
    name: str
    camera: Camera
    cam_from_world: NDArray[np.float64]
    """[4, 4]"""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """What a COLMAP model says, without periods."""

    images: tuple[PosedImage, ...]
    """Registered images, sorted by name."""
    points: Points
    """Sorted by id; ``track_frame`` is an index into `images`."""


def model_kind(folder: Path) -> Literal["binary", "text"] | None:
    """Which form of a complete model a folder has; binary wins, as in COLMAP."""
    if all((folder / f"{stem}.bin").is_file() for stem in MODEL_FILES):
        return "binary"
    if all((folder / f"{stem}.txt").is_file() for stem in MODEL_FILES):
        return "text"
    return None


def read_model(folder: Path) -> Model:
    """Read a model in any of COLMAP's forms.

    Raises:
        SceneError: If files are missing, damaged, or contradict each other.
    """
    kind = model_kind(folder)
    if kind is None:
        found = sorted(p.name for p in folder.iterdir()) if folder.is_dir() else []
        raise SceneError(
            folder,
            expected="a COLMAP model: cameras, images and points3D, all .bin or all .txt",
            found=", ".join(found[:8]) or "nothing",
            todo="copy the model there",
        )
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as name:
        temporary = Path(name)
        if kind == "text":
            reconstruction = read_reconstruction(folder)
            reconstruction.write_binary(name)
            return _assemble(folder, reconstruction, _read_records(temporary)[1])
        check_records(folder)
        images, records = _read_records(folder)
        posed = ((i.image_id, i.quaternion, i.translation, i.camera_id, i.name) for i in images)
        write_without_observations(folder, posed, temporary)
        return _assemble(folder, read_reconstruction(temporary, place=folder), records)


def read_reconstruction(folder: Path, *, place: Path | None = None) -> pycolmap.Reconstruction:
    """Read a model as a pycolmap object.

    Args:
        folder: Of the model.
        place: What an error names instead.

    Raises:
        SceneError: If pycolmap refuses it.
    """
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3  # what is wrong comes as an exception, not on stderr
    try:
        return pycolmap.Reconstruction(str(folder))
    except Exception as error:  # ValueError, RuntimeError, IndexError, MemoryError were all seen
        message = str(error).strip().splitlines() or [type(error).__name__]
        raise SceneError(
            place or folder,
            expected="a model that COLMAP reads",
            found=re.sub(r"^\[[^]]*\] ", "", message[-1]),
            todo="write the model again with COLMAP",
        ) from error
    finally:
        pycolmap.logging.minloglevel = level


def write_model(folder: Path, frames: Sequence[Frame], points: Points) -> None:
    """Write frames and points as a binary model into an existing folder.

    Image, camera and point ids are kept; keypoints without a point are not part of a scene.
    """
    cameras = list({f.camera.camera_id: f.camera for f in frames}.values())
    owner = np.repeat(points.ids, np.diff(points.track_start))
    images, keypoints = posed_images(
        np.array([f.image_id for f in frames], np.int64),
        [f.name for f in frames],
        np.array([f.cam_from_world for f in frames]).reshape(-1, 4, 4),
        np.array([f.camera.camera_id for f in frames], np.int64),
        (points.track_frame.astype(np.int64), owner, points.track_xy),
    )
    tracks = RawPoints(
        ids=points.ids,
        xyz=points.xyz,
        rgb=points.rgb,
        error=points.error,
        track_start=points.track_start,
        track_image=images.ids[points.track_frame],
        track_keypoint=keypoints,
    )
    write_raw_model(folder, cameras, images, tracks)


@dataclass(frozen=True, slots=True, eq=False)
class _Records:
    """Observations of a binary model, checked against its images."""

    points: PointRecords
    image_ids: NDArray[np.int64]
    """All images of the model, registered or not, sorted. [I]"""
    slot: NDArray[np.int64]
    """Index into ``image_ids`` of every observation. [M]"""
    xy: NDArray[np.float64]
    """Pixel position of every observation. [M, 2]"""


def _read_records(folder: Path) -> tuple[list[ImageRecord], _Records]:
    """Read images and points; refuse tracks over images or keypoints that do not exist."""
    images = read_images(folder / "images.bin")
    keypoints = {image.image_id: image.xy for image in images}
    if len(keypoints) < len(images):
        twice = Counter(image.image_id for image in images).most_common(1)[0][0]
        raise _model_error(folder, "one image of each id", f"image id {twice} twice")
    points = read_points(folder / "points3D.bin")
    image, keypoint = points.tracks[:, 0], points.tracks[:, 1].astype(np.int64)
    known = np.array(sorted(keypoints), np.int64)
    slot = np.searchsorted(known, image)
    # One past the end stands for ids above all known ones, and for all where there are none.
    lost = np.append(known, -1)[slot] != image
    if lost.any():
        raise _model_error(
            folder, "tracks over images of the model", f"image {image[lost].min()}, which it lacks"
        )
    lengths = np.array([len(keypoints[i]) for i in known.tolist()], np.int64)
    wrong = (keypoint < 0) | (keypoint >= lengths[slot])
    if wrong.any():
        i = int(np.flatnonzero(wrong)[0])
        raise _model_error(
            folder,
            "tracks over keypoints of the images",
            f"keypoint {keypoint[i]} of image {image[i]}, which has {lengths[slot[i]]}",
        )
    first = np.concatenate([[0], np.cumsum(lengths)])
    every = np.concatenate([np.zeros((0, 2)), *(keypoints[i] for i in known.tolist())])
    return images, _Records(points, known, slot, every[first[slot] + keypoint])


def _assemble(folder: Path, reconstruction: pycolmap.Reconstruction, records: _Records) -> Model:
    images = _posed_images(folder, reconstruction)
    index = {image.image_id: i for i, image in enumerate(images)}
    frame_of = np.array([index.get(i, -1) for i in records.image_ids.tolist()], np.int32)
    frame = frame_of[records.slot]
    if (frame < 0).any():
        lost = records.image_ids[records.slot[frame < 0][0]]
        raise _model_error(folder, "tracks over registered images", f"image {lost} without a pose")
    heads = records.points.heads
    points = Points(
        ids=heads["id"].astype(np.int64),
        xyz=np.ascontiguousarray(heads["xyz"]),
        rgb=np.ascontiguousarray(heads["rgb"]),
        error=np.ascontiguousarray(heads["error"]),
        track_start=records.points.track_start,
        track_frame=frame,
        track_xy=records.xy,
    )
    return Model(images, points)


def _posed_images(folder: Path, model: pycolmap.Reconstruction) -> tuple[PosedImage, ...]:
    """Registered images, sorted by name; refuses two with one name."""
    cameras = {i: from_pycolmap(camera) for i, camera in model.cameras.items()}
    images: dict[str, PosedImage] = {}
    for image_id in model.reg_image_ids():
        image = model.images[image_id]
        try:
            name = str(image.name)
        except UnicodeDecodeError as error:
            raise _model_error(folder, "image names in UTF-8", f"image {image_id}") from error
        pose = _pose(image.cam_from_world())
        if name in images:
            raise _model_error(folder, "one image of each name", f"{name!r} twice")
        images[name] = PosedImage(int(image_id), name, cameras[image.camera_id], pose)
    return tuple(images[name] for name in sorted(images))


def _pose(rigid: pycolmap.Rigid3d) -> NDArray[np.float64]:
    """The same pose as a matrix, NaN for quaternions without a direction. [4, 4]

    Text with few digits has quaternions that are not quite unit, of which pycolmap makes matrices
    that are no rotations.
    """
    x, y, z, w = rigid.rotation.quat
    with np.errstate(all="ignore"):
        length = np.linalg.norm([w, x, y, z])
        if abs(length - 1) <= UNIT:
            matrix = rigid.matrix()[:, :3]
        elif 0 < length < np.inf:
            matrix = rotation_from_quaternion([w, x, y, z])
        else:
            matrix = np.full((3, 3), np.nan)
    return pose_from_rotation_translation(matrix, rigid.translation)


def _model_error(folder: Path, expected: str, found: str) -> SceneError:
    return SceneError(
        folder, expected=expected, found=found, todo="write the model again with COLMAP"
    )
