"""What all writers share: images copied or linked into a new folder."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from chronoscene.checks import check_choice
from chronoscene.errors import SceneError
from chronoscene.scene import Scene

ImageSource = Literal["copy", "link", "symlink", "none"]

IMAGE_SOURCES: tuple[ImageSource, ...] = ("copy", "link", "symlink", "none")
"""``copy``; hard ``link`` where the disk can, else copy; absolute ``symlink``; no images."""

Progress = Callable[[int, int], None]
"""Called with the number of images done and their total."""


def place_images(
    scene: Scene,
    root: Path,
    *,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> None:
    """Put the images of a scene below ``root``, under their names.

    Raises:
        SceneError: If an image is missing.
        ConfigError: If there is no such image source.
    """
    check_choice("image_source", image_source, IMAGE_SOURCES)
    if image_source == "none":
        return
    for done, frame in enumerate(scene.frames, start=1):
        place_image(scene.image_path(frame), root / frame.name, image_source)
        if progress is not None:
            progress(done, len(scene.frames))


def place_image(source: Path, target: Path, image_source: ImageSource) -> None:
    """Copy or link one image.

    Raises:
        SceneError: If it is missing, or its place is taken.
    """
    if not source.is_file():
        raise SceneError(source, expected="an image", found="nothing", todo="copy it there")
    if os.path.lexists(target):  # a/b and a//b; or a and A on a disk that takes them for one
        raise SceneError(
            target,
            expected="a file of its own for each image",
            found="one that another image has",
            todo="rename the image",
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    if image_source == "symlink":
        target.symlink_to(source.resolve())
        return
    if image_source == "link":
        try:
            os.link(source.resolve(), target)
            return
        except OSError:
            pass  # another disk, or one without links
    shutil.copyfile(source, target)
