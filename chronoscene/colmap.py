"""COLMAP models to and from numpy. The only module that imports pycolmap.

pycolmap is the authority on cameras and poses (text and binary, models with and without rigs and
frames). Points and observations come from the binary records (`chronoscene.colmap_records`), which
are checked before pycolmap sees the files; a text model is rewritten as binary in a temporary
folder first.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from chronoscene.colmap_records import PointRecords, check_records, read_keypoints, read_points
from chronoscene.errors import SceneError
from chronoscene.geometry import pose_from_rotation_translation
from chronoscene.scene import Camera, Frame, Points

MODEL_FILES = ("cameras", "images", "points3D")
"""Stems of the files that every model has."""


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
    if kind == "binary":
        check_records(folder)
        keypoints, points = _read_records(folder)
        return _assemble(folder, read_reconstruction(folder), keypoints, points)
    reconstruction = read_reconstruction(folder)
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
        reconstruction.write_binary(temporary)
        keypoints, points = _read_records(Path(temporary))
    return _assemble(folder, reconstruction, keypoints, points)


def read_reconstruction(folder: Path) -> pycolmap.Reconstruction:
    """Read a model as a pycolmap object.

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
            folder,
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
    reconstruction = pycolmap.Reconstruction()
    for camera in {f.camera.camera_id: f.camera for f in frames}.values():
        reconstruction.add_camera_with_trivial_rig(to_pycolmap(camera))
    order = np.argsort(points.track_frame, kind="stable")
    ends = np.searchsorted(points.track_frame[order], np.arange(len(frames) + 1))
    keypoint = np.empty(len(order), np.int64)
    for i, frame in enumerate(frames):
        mine = order[ends[i] : ends[i + 1]]
        keypoint[mine] = np.arange(len(mine))
        image = pycolmap.Image(
            name=frame.name,
            keypoints=points.track_xy[mine].reshape(-1, 2),
            camera_id=frame.camera.camera_id,
            image_id=frame.image_id,
        )
        pose = pycolmap.Rigid3d(frame.cam_from_world[:3])
        reconstruction.add_image_with_trivial_frame(image, pose)
    _add_points(reconstruction, [f.image_id for f in frames], points, keypoint)
    reconstruction.write_binary(str(folder))


def to_pycolmap(camera: Camera) -> pycolmap.Camera:
    """The same camera as a pycolmap object."""
    return pycolmap.Camera(
        camera_id=camera.camera_id,
        model=camera.model,
        width=camera.width,
        height=camera.height,
        params=list(camera.params),
    )


def from_pycolmap(camera: pycolmap.Camera) -> Camera:
    """The same camera as our record."""
    return Camera(
        camera_id=int(camera.camera_id),
        model=camera.model.name,
        width=int(camera.width),
        height=int(camera.height),
        params=tuple(float(p) for p in camera.params),
    )


def _read_records(folder: Path) -> tuple[dict[int, NDArray[np.float64]], PointRecords]:
    return read_keypoints(folder / "images.bin"), read_points(folder / "points3D.bin")


def _assemble(
    folder: Path,
    reconstruction: pycolmap.Reconstruction,
    keypoints: Mapping[int, NDArray[np.float64]],
    records: PointRecords,
) -> Model:
    images = _posed_images(folder, reconstruction)
    index = {image.image_id: i for i, image in enumerate(images)}
    frame, xy = _observations(folder, records, index, keypoints)
    heads = records.heads
    points = Points(
        ids=heads["id"].astype(np.int64),
        xyz=np.ascontiguousarray(heads["xyz"]),
        rgb=np.ascontiguousarray(heads["rgb"]),
        error=np.ascontiguousarray(heads["error"]),
        track_start=records.track_start,
        track_frame=frame,
        track_xy=xy,
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
        matrix = image.cam_from_world().matrix()
        pose = pose_from_rotation_translation(matrix[:, :3], matrix[:, 3])
        if name in images:
            raise _model_error(folder, "one image of each name", f"{name!r} twice")
        images[name] = PosedImage(int(image_id), name, cameras[image.camera_id], pose)
    return tuple(images[name] for name in sorted(images))


def _observations(
    folder: Path,
    records: PointRecords,
    index: Mapping[int, int],
    keypoints: Mapping[int, NDArray[np.float64]],
) -> tuple[NDArray[np.int32], NDArray[np.float64]]:
    """Frame index [M] and pixel position [M, 2] of every observation."""
    image_ids, keypoint = records.tracks[:, 0], records.tracks[:, 1]
    known = np.array(sorted(index.keys() & keypoints.keys()), np.int64)
    slot = np.minimum(np.searchsorted(known, image_ids), max(len(known) - 1, 0))
    if len(image_ids) and (not len(known) or (known[slot] != image_ids).any()):
        lost = image_ids[known[slot] != image_ids][0] if len(known) else image_ids[0]
        raise _model_error(folder, "tracks over registered images", f"image id {lost} in a track")
    if not len(image_ids):
        return np.zeros(0, np.int32), np.zeros((0, 2))
    lengths = np.array([len(keypoints[i]) for i in known.tolist()])
    if ((keypoint < 0) | (keypoint >= lengths[slot])).any():
        raise _model_error(
            folder, "tracks over existing keypoints", "a keypoint index that its image lacks"
        )
    first = np.concatenate([[0], np.cumsum(lengths)])
    xy = np.concatenate([keypoints[i] for i in known.tolist()])[first[slot] + keypoint]
    frame = np.array([index[i] for i in known.tolist()], np.int32)[slot]
    return frame, xy


def _model_error(folder: Path, expected: str, found: str) -> SceneError:
    return SceneError(
        folder, expected=expected, found=found, todo="write the model again with COLMAP"
    )


def _add_points(
    reconstruction: pycolmap.Reconstruction,
    image_ids: Sequence[int],
    points: Points,
    keypoint: NDArray[np.int64],
) -> None:
    """Add points with their ids; ``keypoint`` [M] is the index of an observation in its image."""
    element = pycolmap.TrackElement
    images = np.asarray(image_ids, np.int64)[points.track_frame].tolist()
    pairs = list(zip(images, keypoint.tolist(), strict=True))
    starts = points.track_start.tolist()
    for i, point_id in enumerate(points.ids.tolist()):
        point = pycolmap.Point3D()
        point.xyz = points.xyz[i]
        point.color = points.rgb[i]
        point.error = points.error[i]
        point.track = pycolmap.Track([element(*pair) for pair in pairs[starts[i] : starts[i + 1]]])
        reconstruction.add_point3D_with_id(point_id, point)
