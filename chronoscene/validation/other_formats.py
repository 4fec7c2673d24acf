"""Scenes in other formats: converted into a temporary folder, with links to the images, to be
checked."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from chronoscene import formats
from chronoscene.colmap.raw_model import model_files
from chronoscene.convert import remarks_on
from chronoscene.errors import ChronoSceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.images.store import place_image


@dataclass(frozen=True, slots=True)
class Origin:
    """The format that a scene was converted from."""

    format: str
    """Name in `chronoscene.formats`."""
    error: ChronoSceneError | None = None
    """Why the scene cannot be read; then there is nothing to check."""
    remarks: tuple[str, ...] = ()
    """What the conversion leaves out."""


def other_format(path: Path) -> str | None:
    """The format of a folder that is certainly not in the ChronoScene format, else None.

    A model in ``sparse/0/`` without ``split.txt`` counts as a faulty ChronoScene folder: its images
    may be in subfolders for other reasons than periods.
    """
    if our_format.matches(path) or model_files(path / our_format.MODEL):
        return None
    try:
        return formats.detect_format(path)
    except (ChronoSceneError, OSError):
        return None


@contextmanager
def in_our_format(path: Path) -> Iterator[tuple[Path, Origin | None]]:
    """The folder itself, or a temporary ChronoScene folder of the same scene and its origin."""
    name = other_format(path)
    if name is None:
        yield path, None
        return
    with tempfile.TemporaryDirectory(prefix="chronoscene-") as temporary:
        ours = Path(temporary) / "scene"
        try:
            origin = Origin(name, remarks=_write(path, name, ours))
        except ChronoSceneError as error:
            origin = Origin(name, error)
        yield path if origin.error else ours, origin


def _write(path: Path, name: str, ours: Path) -> tuple[str, ...]:
    """Convert the scene, with links to the existing images; returns what is left out."""
    scene = formats.read_scene(path, format=name)
    our_format.write(scene, ours, image_source="none")
    (ours / "images").mkdir(exist_ok=True)
    for frame in scene.frames:
        source = scene.image_path(frame)
        if source.is_file():
            place_image(source, ours / "images" / frame.name, "symlink")
    return tuple(remarks_on(scene))
