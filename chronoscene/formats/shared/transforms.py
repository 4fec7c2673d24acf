"""Poses and cameras from ``transforms.json`` and its relatives; shared by several formats.

Files of this family hold camera-to-world matrices with OpenGL axes (+x right, +y up, looking along
-z) and intrinsics for all frames or for each. What they say is not trusted: numbers are checked,
and image paths must stay inside the scene folder.
"""

from __future__ import annotations

import os
import posixpath
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.formats.chronoscene import LARGEST_COORDINATE
from chronoscene.formats.shared.json_values import json_error
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.scene.splits import IMAGE_SUFFIXES, split_of

EXTENSIONS = (".png", *(s for s in IMAGE_SUFFIXES if s != ".png"), *map(str.upper, IMAGE_SUFFIXES))
"""Of images whose names have none, in the order in which they are tried: loaders take .png."""

_NOT_RIGID = 1e-3
"""Deviation from a rotation beyond which a matrix is refused; below, the nearest is taken."""


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One frame of such a file."""

    name: str
    """Path below the scene folder."""
    camera: Camera
    cam_from_world: NDArray[np.float64]
    """[4, 4]"""
    image_id: int = 0
    """0 where the file does not say."""


def read_frames(place: Path, data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """The list ``frames``, which has at least one object."""
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise json_error(place, "a list of frames", "none")
    return frames


def head_has(path: Path, text: str, *, length: int = 65536) -> bool:
    """Whether the first bytes of a file have a text."""
    try:
        if not path.is_file():  # a pipe would never end
            return False
        with path.open("rb") as file:
            return text.encode() in file.read(length)
    except OSError:
        return False


def file_name(place: object, folder: str, file_path: object) -> str:
    """Path below the scene folder of a file that another one names.

    Args:
        place: For the message.
        folder: Folder of the other file, below the scene folder; "" if it is directly there.
        file_path: What it says, relative to its folder.

    Raises:
        SceneError: If the path is absolute, leads out of the scene folder, or is no text.
    """
    if not isinstance(file_path, str) or not file_path.strip() or "\0" in file_path:
        raise json_error(place, "a file_path", repr(file_path))
    given = file_path.replace("\\", "/")
    name = posixpath.normpath(posixpath.join(folder, given))
    outside = name in (".", "..") or name.startswith(("../", "/"))
    if outside or given.startswith("/") or PureWindowsPath(given).drive:
        todo = "write the path as it is below the scene folder"
        raise json_error(place, "a file_path inside the scene folder", repr(file_path), todo)
    return name


def image_name(place: object, root: Path, folder: str, file_path: object) -> str:
    """Path of an image below the scene folder; an extension that is left out is found out.

    Args:
        place: For the message.
        root: The scene folder.
        folder: As for `file_name`.
        file_path: As for `file_name`. ``a.1`` may mean ``a.1.png``.

    Raises:
        SceneError: As `file_name`.
    """
    name = file_name(place, folder, file_path)
    suffix = PurePosixPath(name).suffix
    if suffix.lower() in IMAGE_SUFFIXES or os.path.isfile(root / name):
        return name
    there = (name + s for s in EXTENSIONS if os.path.isfile(root / (name + s)))
    return next(there, name if suffix else name + EXTENSIONS[0])


def matrix(place: object, value: object, rows: tuple[int, ...] = (4,)) -> NDArray[np.float64]:
    """A finite matrix with four columns and one of the given numbers of rows, filled up to 4x4."""
    try:
        array = np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.zeros(0)
    expected = f"a matrix of {' or '.join(map(str, rows))} x 4 numbers"
    if array.shape not in [(n, 4) for n in rows]:
        found = " x ".join(map(str, array.shape)) if array.ndim == 2 else "something else"
        raise json_error(place, expected, found)
    if not (np.abs(array) < LARGEST_COORDINATE).all():
        raise json_error(place, expected, "NaN, infinity, or more than any place can have")
    full = np.eye(4)
    full[: len(array)] = array
    if full[3].tolist() != [0, 0, 0, 1]:
        raise json_error(place, "a last row 0 0 0 1", str(full[3].tolist()))
    return full


def nearest_rotation(place: object, block: NDArray[np.float64]) -> NDArray[np.float64]:
    """The rotation nearest to a matrix that is one up to rounding. [3, 3]

    Raises:
        SceneError: If it is none: scaled, mirrored or skewed.
    """
    u, sizes, vt = np.linalg.svd(block)
    rotation: NDArray[np.float64] = u @ vt
    if np.linalg.det(rotation) < 0:
        found = "a mirrored one"
    elif sizes.max() - sizes.min() > 2 * _NOT_RIGID:
        found = "a skewed one"
    elif np.abs(rotation - block).max() > _NOT_RIGID:
        found = f"one scaled by {sizes.mean():.4g}"
    else:
        return rotation
    raise json_error(place, "a rotation in the matrix", found, "export the poses again")


def pose_from_opengl(place: object, world_from_cam: NDArray[np.float64]) -> NDArray[np.float64]:
    """``cam_from_world`` with OpenCV axes of a camera-to-world matrix with OpenGL axes. [4, 4]"""
    rotation = nearest_rotation(place, world_from_cam[:3, :3]) * [1.0, -1.0, -1.0]
    pose = np.eye(4)
    pose[:3, :3] = rotation.T
    pose[:3, 3] = -rotation.T @ world_from_cam[:3, 3]
    return pose


def opengl_from_pose(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of `pose_from_opengl`. [4, 4]"""
    rotation = cam_from_world[:3, :3]
    world_from_cam = np.eye(4)
    world_from_cam[:3, :3] = rotation.T * [1.0, -1.0, -1.0]
    world_from_cam[:3, 3] = -rotation.T @ cam_from_world[:3, 3]
    return world_from_cam


def make_scene(
    path: Path,
    shots: Sequence[Shot],
    grouped: tuple[Mapping[str, int], Sequence[Period]],
    tests: set[str],
    *,
    points: Points,
    rule: str,
    format: str,
) -> Scene:
    """A scene from shots of different names.

    Where all names are below ``images/``, that is the folder of images, and cut off the names.
    """
    prefix = "images/" if all(shot.name.startswith("images/") for shot in shots) else ""
    ids = [shot.image_id for shot in shots]
    known = min(ids) > 0 and max(ids) < 2**31 and len(set(ids)) == len(ids)
    ordered = sorted(shots, key=lambda shot: shot.name)
    frames = tuple(
        Frame(
            name=shot.name.removeprefix(prefix),
            image_id=shot.image_id if known else i,
            camera=shot.camera,
            cam_from_world=shot.cam_from_world,
            period=grouped[0][shot.name],
            split=split_of(shot.name, tests),
        )
        for i, shot in enumerate(ordered, start=1)
    )
    return Scene(
        name=path.resolve().name,
        root=path,
        images_root=path / prefix if prefix else path,
        frames=frames,
        points=points,
        periods=tuple(grouped[1]),
        split_rule=rule,
        format=format,
    )


def check_distinct(place: object, shots: Sequence[Shot]) -> None:
    """Refuse two frames of one image."""
    seen: set[str] = set()
    for shot in shots:
        if shot.name in seen:
            raise json_error(place, "each image once", f"{shot.name!r} twice")
        seen.add(shot.name)
