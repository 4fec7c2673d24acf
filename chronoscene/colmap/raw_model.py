"""A COLMAP model as its files say it, with nothing checked or repaired.

Unlike `chronoscene.colmap.model` this keeps what contradicts itself (two images of one name,
tracks over missing images, poses that are not numbers), and reads each file by itself, so that one
damaged file does not hide the problems in the others. No length in a file is trusted before it was
compared with the size of the file.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from chronoscene.colmap import binary, text
from chronoscene.colmap.arrays import Damage, DamagedError, RawImages, RawPoints, RawRigs
from chronoscene.errors import SceneError
from chronoscene.scene import Camera

MODEL_FILES = ("cameras", "images", "points3D")
"""Stems of the files that every model has."""

FORMS = (".bin", ".txt")
"""Suffixes of model files."""


@dataclass(frozen=True, slots=True)
class RawModel:
    """The parts of a model; None for a part that is absent or damaged."""

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
    """Which file counts for each stem. A complete binary model wins, then a complete text one."""
    forms = [
        {stem: stem + form for stem in MODEL_FILES if (folder / (stem + form)).is_file()}
        for form in FORMS
    ]
    complete = (files for files in forms if len(files) == len(MODEL_FILES))
    return next(complete, {**forms[1], **forms[0]})


def numbered_models(scene: Path) -> list[Path]:
    """Folders ``sparse/0``, ``sparse/1`` ... that have files of a model, in this order."""
    try:
        folders = [p for p in (scene / "sparse").iterdir() if re.fullmatch("[0-9]{1,9}", p.name)]
    except OSError:
        return []
    return [p for p in sorted(folders, key=lambda p: (int(p.name), p.name)) if model_files(p)]


def model_kind(folder: Path) -> Literal["binary", "text"] | None:
    """Which form of a complete model a folder has; binary wins, as in COLMAP."""
    files = model_files(folder)
    forms = {Path(file).suffix for file in files.values()}
    if len(files) < len(MODEL_FILES) or len(forms) > 1:
        return None
    return "binary" if forms == {".bin"} else "text"


def read_raw_model(folder: Path) -> RawModel:
    """Read what can be read; never raises for what is in the files."""
    files = model_files(folder)
    readers: dict[str, Callable[[Path], Any]] = {
        "cameras.bin": binary.read_cameras,
        "images.bin": binary.read_images,
        "points3D.bin": binary.read_points,
        "cameras.txt": text.read_cameras,
        "images.txt": text.read_images,
        "points3D.txt": text.read_points,
    }
    parts: dict[str, Any] = {}
    damages: list[Damage] = []
    for stem, file in files.items():
        try:
            parts[stem] = readers[file](folder / file)
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
