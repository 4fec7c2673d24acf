"""A COLMAP model as its files have it, in arrays, with nothing checked or repaired.

What contradicts itself is kept: two images of one name, tracks over missing images, poses that are
not numbers. `chronoscene.colmap.model` reads and checks models.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from chronoscene.arrays import Array, Ints
from chronoscene.scene import Camera
from chronoscene.scene.scene import PointTable

MODEL_FILES = ("cameras", "images", "points3D")  # Stems of the files that every model has
FORMS = (".bin", ".txt")  # Suffixes of model files

PLACES = {
    "sparse": "images",  # COLMAP, GLOMAP
    "colmap/sparse": "images",  # nerfstudio
    "distorted/sparse": "input",  # the conversion script of 3DGS, before it undistorts
    "dense/0/sparse": "dense/0/images",  # COLMAP's automatic reconstruction, undistorted
    "dense/sparse": "dense/images",  # COLMAP's undistorter
    "reconstruction": "images",  # hloc, pycolmap
    "sfm": "images",
    "": "images",
}
"""Folders of models in a project by program, each with the folder of its images.

The model is in the folder itself or in a numbered one inside of it, which comes first."""

FoundModel = tuple[str, str]
"""Folders of a model and of its images, both below the project."""


@dataclass(frozen=True, slots=True, eq=False)
class RawImages:
    """Registered images in the order of the file (I images, K keypoints)."""

    ids: Ints
    """[I]"""
    names: tuple[str, ...]
    """Bytes that are not UTF-8 as lone surrogates, as Python has them in file names."""
    quaternions: Array
    """wxyz, as stored. [I, 4]"""
    translations: Array
    """[I, 3]"""
    camera_ids: Ints
    """[I]"""
    keypoint_start: Ints
    """Keypoints of image i are ``keypoint_start[i]:keypoint_start[i + 1]``. [I + 1]"""
    keypoint_xy: Array
    """Pixels. [K, 2]"""
    keypoint_point: Ints
    """Point id, negative for none. [K]"""

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class RawPoints(PointTable):
    """Sparse points sorted by id, with tracks over what the model calls images and keypoints."""

    track_image: Ints
    """Image id. [M]"""
    track_keypoint: Ints
    """Index among the keypoints of the image. [M]"""


Pose = tuple[float, ...]
"""Quaternion wxyz and translation."""

IDENTITY: Pose = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)

Sensor = tuple[int, int]
"""Type and id."""

CAMERA = 0  # Type of the sensors that are cameras


@dataclass(frozen=True, slots=True)
class RawFrame:
    """Pose of a rig when its images were taken."""

    frame_id: int
    rig_id: int
    rig_from_world: Pose
    data: tuple[tuple[Sensor, int], ...]
    """Sensors, and the ids of what they took: of cameras, image ids."""


@dataclass(frozen=True, slots=True)
class RawRigs:
    """``rigs`` and ``frames``, which COLMAP writes beside the three other files since 3.12."""

    rigs: dict[int, dict[Sensor, Pose | None]]
    """By rig id, the poses of its sensors (``sensor_from_rig``), None if not known."""
    frames: tuple[RawFrame, ...]


@dataclass(frozen=True, slots=True)
class Damage:
    """A file of the model, or a line of it, that cannot be read."""

    file: str
    """Name of the file, with a line number for text (``cameras.txt:3``)."""
    expected: str
    found: str


class DamagedError(Exception):
    """Error with all damages that a reader found."""

    def __init__(self, *damages: Damage) -> None:
        super().__init__("; ".join(f"{d.file}: {d.found}" for d in damages))
        self.damages = damages


@dataclass(frozen=True, slots=True)
class RawModel:
    """Contents of a model; None for a file that is absent or damaged."""

    folder: Path
    files: dict[str, str]
    """Stem to name of the file that counts, ``cameras`` to ``cameras.bin``; absent ones not."""
    cameras: tuple[Camera, ...] | None
    images: RawImages | None
    points: RawPoints | None
    rigs: RawRigs | None
    """None also where one of the two files is absent."""
    damages: tuple[Damage, ...]


def model_files(folder: Path) -> dict[str, str]:
    """File to read for each stem. A complete binary model wins, then a complete text one."""
    forms = [
        {stem: stem + form for stem in MODEL_FILES if (folder / (stem + form)).is_file()}
        for form in FORMS
    ]
    complete = (files for files in forms if len(files) == len(MODEL_FILES))
    return next(complete, {**forms[1], **forms[0]})


def numbered_models(folder: Path) -> list[Path]:
    """Folders ``0``, ``1`` ... that have files of a model, in this order."""
    try:
        folders = [p for p in folder.iterdir() if re.fullmatch("[0-9]{1,9}", p.name)]
    except OSError:
        return []
    return [p for p in sorted(folders, key=lambda p: (int(p.name), p.name)) if model_files(p)]


def model_kind(folder: Path) -> Literal["binary", "text"] | None:
    """Form of the complete model in a folder; binary wins, as in COLMAP."""
    files = model_files(folder)
    forms = {Path(file).suffix for file in files.values()}
    if len(files) < len(MODEL_FILES) or len(forms) > 1:
        return None
    return "binary" if forms == {".bin"} else "text"


def find_model(project: Path) -> FoundModel | None:
    """Find the model of a project and the folder of its images, below the project; None if none.

    Of several models the first in the order of `PLACES`, complete or not.
    """
    for place, images in PLACES.items():
        if place == "distorted/sparse" and not (project / images).is_dir():
            images = "images"  # the script was stopped, or the folder renamed
        for folder in numbered_models(project / place) if place else ():
            return f"{place}/{folder.name}", images
        # Beside other files, cameras.txt or images.txt alone may be anything.
        if model_files(project / place) if place else model_kind(project):
            return place, images
    return None


def find_stray_model(project: Path) -> str | None:
    """Find a complete model below a project, in an unusual place."""
    deep = ("/".join("*" * depth) for depth in range(1, 5))
    files = (file for stars in deep for file in sorted(project.glob(f"{stars}/cameras.*")))
    folders = (file.parent for file in files if model_kind(file.parent))
    return next((folder.relative_to(project).as_posix() for folder in folders), None)
