"""Poses and cameras from ``transforms.json`` and its relatives; shared by several formats.

Files of this family hold camera-to-world matrices with OpenGL axes (+x right, +y up, looking along
-z) and intrinsics for all frames or for each. They are not trusted: numbers are checked, and image
paths must stay inside the scene folder. Frames become `PosedImage`, with 0 for an unknown id.
"""

from __future__ import annotations

import math
import os
import posixpath
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.colmap.model import PosedImage
from chronoscene.formats.chronoscene import MAX_COORDINATE
from chronoscene.formats.shared.grouping import Grouped
from chronoscene.images.decoding import image_size
from chronoscene.io.documents import json_error, number
from chronoscene.scene import Camera, Frame, Points, Scene
from chronoscene.scene.cameras import CAMERA_MODELS, MAX_SIDE
from chronoscene.scene.geometry import pose_from_rotation_translation
from chronoscene.scene.splits import IMAGE_SUFFIXES, split_of

EXTENSIONS = (".png", *(s for s in IMAGE_SUFFIXES if s != ".png"), *map(str.upper, IMAGE_SUFFIXES))
"""Extensions of images whose names have none, in the order of trial: loaders take .png."""

_NOT_RIGID = 1e-3
"""Deviation from a rotation beyond which a matrix is refused; below, the nearest is taken."""

MODEL_KEYS = {
    name: CAMERA_MODELS[name].distortion
    for name in (
        "SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE",
    )
}  # fmt: skip
"""Camera models that such a file can name, with the keys of their distortion in COLMAP's order."""

_LIST_ORDER = ("k1", "k2", "k3", "k4", "p1", "p2")  # Order of ``distortion_params``

_REPLACES = {
    "camera_angle_x": ("fl_x", "fl_y", "camera_angle_y"),  # alone, it means square pixels
    "camera_angle_y": ("fl_y",),
    "camera_model": ("is_fisheye",),
    **dict.fromkeys(_LIST_ORDER, ("distortion_params",)),
}
"""Keys of a frame, with those of a file that say the same and would otherwise go first."""


def read_frames(place: Path, data: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Return the list ``frames``, which has at least one object."""
    frames = data.get("frames")
    if not isinstance(frames, list) or not frames or not all(isinstance(f, dict) for f in frames):
        raise json_error(place, "a list of frames", "none")
    return frames


def shared_keys(data: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a file that hold for all frames."""
    return {key: value for key, value in data.items() if key != "frames"}


def frame_keys(shared: Mapping[str, Any], frame: Mapping[str, Any]) -> dict[str, Any]:
    """Return the keys of a frame, and those of its file that the frame does not override."""
    own = (keys for key, keys in _REPLACES.items() if frame.get(key) is not None)
    replaced = {key for keys in own for key in keys}
    return {key: value for key, value in shared.items() if key not in replaced} | dict(frame)


def file_name(place: object, folder: str, file_path: object) -> str:
    """Return the path below the scene folder of a file that another file names.

    Args:
        place: For the message.
        folder: Folder of the other file, below the scene folder; "" for the scene folder.
        file_path: As the other file has it, relative to its folder.

    Raises:
        SceneError: If the path is absolute, leads out of the scene folder, or is not text.
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
    """Return the path of an image below the scene folder; see `file_name`.

    A missing extension is found, so ``a.1`` may mean ``a.1.png``.
    """
    name = file_name(place, folder, file_path)
    suffix = PurePosixPath(name).suffix
    if suffix.lower() in IMAGE_SUFFIXES or os.path.isfile(root / name):
        return name
    there = (name + s for s in EXTENSIONS if os.path.isfile(root / (name + s)))
    return next(there, name if suffix else name + EXTENSIONS[0])


def matrix(place: object, value: object, rows: tuple[int, ...] = (4,)) -> NDArray[np.float64]:
    """Check a matrix with four columns and one of these numbers of rows; fill it up to 4x4."""
    try:
        array = np.asarray(value, np.float64)
    except (ValueError, TypeError, OverflowError):
        array = np.zeros(0)
    expected = f"a matrix of {' or '.join(map(str, rows))} x 4 numbers"
    if array.shape not in [(n, 4) for n in rows]:
        found = " x ".join(map(str, array.shape)) if array.ndim == 2 else "something else"
        raise json_error(place, expected, found)
    if not (np.abs(array) < MAX_COORDINATE).all():
        raise json_error(place, expected, "NaN, infinity, or absurdly large numbers")
    full = np.eye(4)
    full[: len(array)] = array
    if full[3].tolist() != [0, 0, 0, 1]:
        raise json_error(place, "a last row 0 0 0 1", str(full[3].tolist()))
    return full


def nearest_rotation(place: object, block: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation nearest to a matrix that is a rotation up to rounding. [3, 3]

    Raises:
        SceneError: If it is scaled, mirrored or skewed.
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
    return pose_from_rotation_translation(rotation.T, -rotation.T @ world_from_cam[:3, 3])


def opengl_from_pose(cam_from_world: NDArray[np.float64]) -> NDArray[np.float64]:
    """Inverse of `pose_from_opengl`. [4, 4]"""
    rotation = cam_from_world[:3, :3].T
    centre = -rotation @ cam_from_world[:3, 3]
    return pose_from_rotation_translation(rotation * [1.0, -1.0, -1.0], centre)


def make_scene(
    path: Path,
    images: Sequence[PosedImage],
    grouped: Grouped,
    tests: set[str],
    *,
    points: Points,
    rule: str,
    format: str,
) -> Scene:
    """Make a scene of images of different names, which are paths below the scene folder.

    Where all names are below ``images/``, that is the folder of images, and cut off the names.
    Images with the id 0 are numbered.
    """
    prefix = "images/" if all(image.name.startswith("images/") for image in images) else ""
    ids = [image.image_id for image in images]
    known = min(ids) > 0 and max(ids) < 2**31 and len(set(ids)) == len(ids)
    ordered = sorted(images, key=lambda image: image.name)
    period_of, periods = grouped
    frames = tuple(
        Frame(
            name=image.name.removeprefix(prefix),
            image_id=image.image_id if known else i,
            camera=image.camera,
            cam_from_world=image.cam_from_world,
            period=period_of[image.name],
            split=split_of(image.name, tests),
        )
        for i, image in enumerate(ordered, start=1)
    )
    return Scene(
        name=path.resolve().name,
        root=path,
        images_root=path / prefix if prefix else path,
        frames=frames,
        points=points,
        periods=periods,
        split_rule=rule,
        format=format,
    )


def check_distinct(place: object, images: Sequence[PosedImage]) -> None:
    """Refuse two frames of one image."""
    twice, times = Counter(image.name for image in images).most_common(1)[0]
    if times > 1:
        raise json_error(place, "each image once", f"{twice!r} twice")


class CameraTable:
    """Cameras of a scene; frames with equal intrinsics share one."""

    def __init__(self) -> None:
        self._ids: dict[tuple[Any, ...], int] = {}

    def camera(self, place: object, data: Mapping[str, Any], image: Path) -> Camera:
        """Return the camera of a frame.

        Args:
            place: For messages.
            data: Keys of the frame and its file; see `frame_keys`.
            image: File from which the size is read if the keys lack it.
        """
        width, height = _size(place, data, image)
        fx, fy = _focals(place, data, width, height)
        cx, cy = number(place, data, "cx"), number(place, data, "cy")
        model, distortion = _model(place, data)
        if CAMERA_MODELS[model].num_focals == 1:
            if fx != fy:
                raise json_error(place, f"equal fl_x and fl_y of a {model}", f"{fx}, {fy}")
            focals: tuple[float, ...] = (fx,)
        else:
            focals = (fx, fy)
        centre = (width / 2 if cx is None else cx, height / 2 if cy is None else cy)
        params = (*focals, *centre, *distortion)
        key = (model, width, height, params)
        return Camera(self._ids.setdefault(key, len(self._ids) + 1), *key)


def _size(place: object, data: Mapping[str, Any], image: Path) -> tuple[int, int]:
    width, height = number(place, data, "w"), number(place, data, "h")
    if width is None or height is None:
        return image_size(image)
    for value in (width, height):
        if not (1 <= value <= MAX_SIDE and value == int(value)):
            raise json_error(place, "w and h in whole pixels", f"{width:g} x {height:g}")
    return int(width), int(height)


def _focals(place: object, data: Mapping[str, Any], width: int, height: int) -> tuple[float, float]:
    fx = number(place, data, "fl_x") or _from_angle(place, data, "camera_angle_x", width)
    fy = number(place, data, "fl_y") or _from_angle(place, data, "camera_angle_y", height) or fx
    fx = fx or fy
    if fx is None or fy is None or min(fx, fy) <= 0:
        raise json_error(place, "a positive fl_x, or camera_angle_x in radians", f"{fx}, {fy}")
    return fx, fy


def _from_angle(place: object, data: Mapping[str, Any], key: str, pixels: int) -> float | None:
    """Focal length of a field of view over a number of pixels."""
    angle = number(place, data, key)
    if angle is None:
        return None
    if not 0 < angle < math.pi:
        raise json_error(place, f"{key} between 0 and pi", f"{angle:g}")
    return pixels / 2 / math.tan(angle / 2)


def _model(place: object, data: Mapping[str, Any]) -> tuple[str, tuple[float, ...]]:
    """Camera model and distortion; the named model, or one that has all that is not zero."""
    values = _distortion(place, data)
    named = data.get("camera_model")
    if named is not None and named not in tuple(MODEL_KEYS):
        known = f"a camera_model {', '.join(MODEL_KEYS)}"
        todo = "render perspective views first" if named == "EQUIRECTANGULAR" else "correct it"
        raise json_error(place, known, repr(named)[:40], todo)
    used = {key for key, value in values.items() if value}
    if data.get("is_fisheye"):
        named = "OPENCV_FISHEYE"
    elif named is None:
        named = "OPENCV" if used else "PINHOLE"
    if named != "OPENCV_FISHEYE" and not used <= set(MODEL_KEYS[named]):
        named = "OPENCV"
    if named == "OPENCV" and "k3" in used and "k4" not in used:
        ks = (values[key] for key in ("k1", "k2", "p1", "p2", "k3"))
        return "FULL_OPENCV", (*ks, 0.0, 0.0, 0.0)
    if wrong := sorted(used - set(MODEL_KEYS[named])):
        raise json_error(place, f"distortion of {named}", ", ".join(wrong))
    return named, tuple(values[key] for key in MODEL_KEYS[named])


def _distortion(place: object, data: Mapping[str, Any]) -> dict[str, float]:
    listed = data.get("distortion_params")
    if listed is not None:
        if not isinstance(listed, list) or len(listed) > len(_LIST_ORDER):
            raise json_error(place, f"distortion_params {', '.join(_LIST_ORDER)}", "something else")
        data = dict(zip(_LIST_ORDER, listed, strict=False))
    return {key: number(place, data, key) or 0.0 for key in _LIST_ORDER}
