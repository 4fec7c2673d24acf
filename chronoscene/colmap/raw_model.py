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
from typing import Any

from chronoscene.colmap.arrays import RawImages, RawPoints
from chronoscene.colmap.binary import check_records
from chronoscene.colmap.model import MODEL_FILES
from chronoscene.errors import SceneError
from chronoscene.scene import Camera

FORMS = (".bin", ".txt")
"""Suffixes of model files."""


@dataclass(frozen=True, slots=True)
class Damage:
    """Why a file of the model, or a line of it, cannot be read."""

    file: str
    """Name of the file, with a line number for text (``cameras.txt:3``)."""
    expected: str
    found: str


class DamagedError(Exception):
    """Carries damages out of a reader."""

    def __init__(self, *damages: Damage) -> None:
        super().__init__("; ".join(f"{d.file}: {d.found}" for d in damages))
        self.damages = damages


@dataclass(frozen=True, slots=True)
class RawModel:
    """The parts of a model; None for a part that is absent or damaged."""

    folder: Path
    files: dict[str, str]
    """Stem to name of the file that counts, ``cameras`` to ``cameras.bin``; absent ones not."""
    cameras: tuple[Camera, ...] | None
    images: RawImages | None
    points: RawPoints | None
    damages: tuple[Damage, ...]


def model_files(folder: Path) -> dict[str, str]:
    """Which file counts for each stem. A complete binary model wins, then a complete text one."""
    binary, text = (
        {stem: stem + form for stem in MODEL_FILES if (folder / (stem + form)).is_file()}
        for form in FORMS
    )
    for files in (binary, text):
        if len(files) == len(MODEL_FILES):
            return files
    return {**text, **binary}


def numbered_models(scene: Path) -> list[Path]:
    """Folders ``sparse/0``, ``sparse/1`` ... that have files of a model, in this order."""
    try:
        folders = [p for p in (scene / "sparse").iterdir() if re.fullmatch("[0-9]{1,9}", p.name)]
    except OSError:
        return []
    return [p for p in sorted(folders, key=lambda p: (int(p.name), p.name)) if model_files(p)]


def read_raw_model(folder: Path) -> RawModel:
    """Read what can be read; never raises for what is in the files."""
    from chronoscene.colmap import raw_binary
    from chronoscene.colmap import text as raw_text  # they import this module

    files = model_files(folder)
    readers: dict[str, Callable[[Path], Any]] = {
        "cameras.bin": raw_binary.read_cameras,
        "images.bin": raw_binary.read_images,
        "points3D.bin": raw_binary.read_points,
        "cameras.txt": raw_text.read_cameras,
        "images.txt": raw_text.read_images,
        "points3D.txt": raw_text.read_points,
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
    damages.extend(_rig_damages(folder, files, damages))
    cameras, images, points = (parts.get(stem) for stem in MODEL_FILES)
    return RawModel(folder, files, cameras, images, points, tuple(damages))


def _damage(file: str, error: OSError | SceneError) -> Damage:
    if isinstance(error, SceneError):
        return Damage(file, error.expected, error.found)
    return Damage(file, "a file that can be read", error.strerror or "an error")


def _rig_damages(folder: Path, files: dict[str, str], damages: list[Damage]) -> list[Damage]:
    """Damages of ``rigs.bin`` and ``frames.bin``, which binary models have since COLMAP 3.12."""
    if files.get("cameras") != "cameras.bin" or any(d.file == "cameras.bin" for d in damages):
        return []
    try:
        check_records(folder)
    except SceneError as error:
        return [_damage(Path(error.place).name, error)]
    return []
