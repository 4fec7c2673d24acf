"""COLMAP models: read as they are, read and checked for use, and written.

pycolmap is the authority on cameras and poses (text and binary, models with and without rigs and
frames). Points and observations come from `chronoscene.colmap.binary` and are checked here;
pycolmap does not see those of binary models, which saves a third of the time. A text model is
rewritten as binary in a temporary folder first.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.colmap import binary, text
from chronoscene.colmap.raw_model import (
    MODEL_FILES,
    Damage,
    DamagedError,
    RawImages,
    RawModel,
    RawPoints,
    model_files,
    model_kind,
)
from chronoscene.colmap.write import posed_images, write_raw_model, write_without_observations
from chronoscene.errors import SceneError
from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene import Camera, Frame, Points
from chronoscene.scene.cameras import from_pycolmap
from chronoscene.scene.geometry import pose_from_rotation_translation, rotation_from_quaternion


@dataclass(frozen=True, slots=True, eq=False)
class PosedImage:
    """A registered image of a model."""

    image_id: int
    name: str
    camera: Camera
    cam_from_world: Array
    """[4, 4]"""


@dataclass(frozen=True, slots=True, eq=False)
class Model:
    """Registered images and points of a COLMAP model, without periods."""

    images: tuple[PosedImage, ...]
    """Registered images, sorted by name."""
    points: Points
    """Sorted by id; ``track_frame`` is an index into `images`."""


def read_raw_model(folder: Path) -> RawModel:
    """Read each file by itself, so that a damaged one does not hide problems in the others.

    Never raises for what is in the files.
    """
    files = model_files(folder)
    parts: dict[str, Any] = {}
    damages: list[Damage] = []
    for stem, file in files.items():
        form: Any = text if file.endswith(".txt") else binary
        read = {
            "cameras": form.read_cameras,
            "images": form.read_images,
            "points3D": form.read_points,
        }[stem]
        try:
            parts[stem] = read(folder / file)
        except DamagedError as error:
            damages.extend(error.damages)
        except (OSError, SceneError) as error:
            damages.append(_damage(file, error))
    rigs = None
    try:
        is_text = files.get("cameras") == "cameras.txt"
        rigs = text.read_rigs(folder) if is_text else binary.read_rigs(folder)
    except SceneError as error:
        if "cameras" in parts:
            damages.append(_damage(Path(error.place).name, error))
    cameras, images, points = (parts.get(stem) for stem in MODEL_FILES)
    return RawModel(folder, files, cameras, images, points, rigs, tuple(damages))


def _damage(file: str, error: OSError | SceneError) -> Damage:
    if isinstance(error, SceneError):
        return Damage(file, error.expected, error.found)
    return Damage(file, "a file that can be read", error.strerror or "an error")


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
    if kind == "text":
        with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
            reconstruction = read_reconstruction(folder)
            reconstruction.write_binary(temporary)
            for image_id, name in text.read_long_names(folder / "images.txt").items():
                if image_id in reconstruction.images:
                    whole: Any = name.encode("utf-8", "surrogateescape")
                    reconstruction.images[image_id].name = whole
            images = _posed_images(folder, reconstruction)
            raw = binary.read_images(Path(temporary) / "images.bin")
            points = binary.read_points(Path(temporary) / "points3D.bin")
    else:
        binary.read_cameras(folder / "cameras.bin")  # pycolmap ignores that a file ends early
        binary.read_rigs(folder)
        raw = binary.read_images(folder / "images.bin")
        points = binary.read_points(folder / "points3D.bin")
        images = read_poses(folder, raw)
    return Model(images, _checked_points(folder, images, raw, points))


def read_poses(folder: Path, images: RawImages) -> tuple[PosedImage, ...]:
    """Registered images of a binary model as COLMAP understands them, sorted by name.

    pycolmap checks everything that a pose depends on: cameras, rigs, frames, names. It gets the
    model without points and keypoints, which takes a fraction of the time.

    Args:
        folder: Of the model.
        images: Content of its ``images.bin``.

    Raises:
        SceneError: If pycolmap refuses the model, or an id or a name occurs twice.
    """
    ids = np.sort(images.ids)
    if len(twice := ids[1:][ids[1:] == ids[:-1]]):
        raise _model_error(folder, "one image of each id", f"image id {twice[0]} twice")
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
        write_without_observations(folder, images, Path(temporary))
        return _posed_images(folder, read_reconstruction(Path(temporary), place=folder))


def read_reconstruction(folder: Path, *, place: Path | None = None) -> pycolmap.Reconstruction:
    """Read a model as a pycolmap object; an error names the folder, or ``place`` instead.

    Raises:
        SceneError: If pycolmap refuses it.
    """
    level = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3  # errors come as exceptions, not on stderr
    try:
        return pycolmap.Reconstruction(str(folder))
    except Exception as error:  # ValueError, RuntimeError, IndexError, MemoryError were all seen
        message = str(error).strip().splitlines() or [type(error).__name__]
        found = re.sub(r"^\[[^]]*\] ", "", message[-1])
        raise _model_error(place or folder, "a model that COLMAP reads", found) from error
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


def copy_poses(source: Path, folder: Path, frames: Sequence[Frame]) -> bool:
    """Copy the poses of frames from one model to another, to the last bit, if it has them.

    Reading a pose as a matrix and writing it as a quaternion may change its last bits.

    Args:
        source: Folder of the other model, if there is one. Its images file may lack the frames, or
            have other poses: those of the frames may come from rigs, or from another file.
        folder: Binary model without rigs and frames, as `write_model` writes it.
        frames: Frames of ``folder``, some or all.

    Returns:
        False if nothing was copied.
    """
    old, new = read_raw_model(source).images, read_raw_model(folder)
    row = {} if old is None else {name: i for i, name in enumerate(old.names)}
    if old is None or not all(frame.name in row for frame in frames):
        return False
    rows = [row[frame.name] for frame in frames]
    poses = np.stack([frame.cam_from_world for frame in frames])
    for found, pose in (
        (rotation_from_quaternion(old.quaternions[rows]), poses[:, :3, :3]),
        (old.translations[rows], poses[:, :3, 3]),
    ):
        if not np.allclose(found, pose, rtol=1e-9, atol=1e-9):
            return False
    assert new.cameras and new.images is not None and new.points is not None
    place = {name: i for i, name in enumerate(new.images.names)}
    to = [place[frame.name] for frame in frames]
    quaternions, translations = new.images.quaternions.copy(), new.images.translations.copy()
    quaternions[to], translations[to] = old.quaternions[rows], old.translations[rows]
    images = replace(new.images, quaternions=quaternions, translations=translations)
    write_raw_model(folder, new.cameras, images, new.points)
    return True


def _checked_points(
    folder: Path, images: Sequence[PosedImage], raw: RawImages, points: RawPoints
) -> Points:
    """Points whose tracks refer to the posed images; all images and keypoints must exist."""
    order = np.argsort(raw.ids)
    known = raw.ids[order]
    image, keypoint = points.track_image, points.track_keypoint
    slot = np.searchsorted(known, image)
    # One past the end stands for ids above all known ones, and for all where there are none.
    lost = np.append(known, -1)[slot] != image
    if lost.any():
        found = f"image {image[lost].min()}, which it lacks"
        raise _model_error(folder, "tracks over images of the model", found)
    row = slot if (known == raw.ids).all() else order[slot]
    lengths = np.diff(raw.keypoint_start)[row]
    wrong = np.flatnonzero((keypoint < 0) | (keypoint >= lengths))
    if len(wrong):
        i = wrong[0]
        found = f"keypoint {keypoint[i]} of image {image[i]}, which has {lengths[i]}"
        raise _model_error(folder, "tracks over keypoints of the images", found)
    index = {posed.image_id: i for i, posed in enumerate(images)}
    frame = np.array([index.get(i, -1) for i in raw.ids.tolist()], np.int32)[row]
    if (frame < 0).any():
        found = f"image {image[frame < 0][0]} without a pose"
        raise _model_error(folder, "tracks over registered images", found)
    return Points(
        ids=points.ids,
        xyz=points.xyz,
        rgb=points.rgb,
        error=points.error,
        track_start=points.track_start,
        track_frame=frame,
        track_xy=raw.keypoint_xy[raw.keypoint_start[row] + keypoint],
    )


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


def _pose(rigid: pycolmap.Rigid3d) -> Array:
    """Convert a pose to a matrix, NaN for quaternions without a direction. [4, 4]

    Text with few digits has quaternions that are not quite unit; the matrices that pycolmap makes
    of them are not rotations.
    """
    x, y, z, w = rigid.rotation.quat
    with np.errstate(all="ignore"):
        length = np.linalg.norm([w, x, y, z])
        if abs(length - 1) <= 1e-9:  # unit up to rounding
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
