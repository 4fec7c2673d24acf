"""Scenes of other formats, made checkable: read, and written in ours into a temporary folder.

The images there are links, so that nothing is copied.
"""

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
from chronoscene.formats.shared.writing import place_image


@dataclass(frozen=True, slots=True)
class Origin:
    """What a scene was before it became what is checked."""

    format: str
    """Its name in `chronoscene.formats`."""
    error: ChronoSceneError | None = None
    """Why it cannot be read; then there is nothing to check."""
    remarks: tuple[str, ...] = ()
    """What it has that does not become part of the scene."""


def other_format(path: Path) -> str | None:
    """The format of a folder that is of another one than ours beyond doubt.

    A model in ``sparse/0/`` is taken for ours, without ``split.txt`` for ours with a fault: its
    images may be in folders for other reasons than periods.
    """
    if our_format.matches(path) or model_files(path / our_format.MODEL):
        return None
    try:
        return formats.detect_format(path)
    except (ChronoSceneError, OSError):
        return None


@contextmanager
def in_our_format(path: Path) -> Iterator[tuple[Path, Origin | None]]:
    """The folder itself, or a temporary one with the same scene in our format, and its origin."""
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
    """Write the scene with links to the images that are there; returns what is left out."""
    scene = formats.read_scene(path, format=name)
    our_format.write(scene, ours, image_source="none")
    (ours / "images").mkdir(exist_ok=True)
    for frame in scene.frames:
        source = scene.image_path(frame)
        if source.is_file():
            place_image(source, ours / "images" / frame.name, "symlink")
    return tuple(remarks_on(scene))
