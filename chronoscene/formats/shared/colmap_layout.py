"""What the formats share that are a COLMAP model beside a folder of images."""

from __future__ import annotations

import os
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Literal

import numpy as np

from chronoscene.colmap.model import Model, read_model
from chronoscene.colmap.raw_model import model_kind
from chronoscene.errors import SceneError
from chronoscene.formats.chronoscene import SPLIT, check_image, make_frames
from chronoscene.scene import Period, Scene
from chronoscene.scene.splits import IMAGE_SUFFIXES

MODELS = ("sparse/0", "sparse")
"""Where models are looked for, in this order."""


def find_model(path: Path) -> Path | None:
    """Folder of the model of a scene that is not in the ChronoScene format."""
    if (path / SPLIT).exists():
        return None
    return next((path / m for m in MODELS if model_kind(path / m) is not None), None)


def scan(folder: Path) -> tuple[list[str], list[str]]:
    """Names of the folders and of the images directly in a folder, sorted.

    A folder that is not there, or may not be looked into, counts as empty.
    """
    folders, images = [], []
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir():
                    folders.append(entry.name)
                elif entry.name.lower().endswith(IMAGE_SUFFIXES):
                    images.append(entry.name)
    except OSError:
        return [], []
    return sorted(folders), sorted(images)


def layout(images: Path) -> Literal["folders", "flat", "none"]:
    """Whether images are in folders, or at least one directly in ``images``."""
    folders, files = scan(images)
    if files:
        return "flat"
    return "folders" if folders else "none"


def read_images(path: Path, images: Path) -> Model:
    """Read and check the model of a scene.

    Raises:
        SceneError: If there is none, it has no image, or a name, pose or camera is of no use.
    """
    folder = find_model(path)
    if folder is None or not images.is_dir():
        raise SceneError(
            path,
            expected=f"{images.relative_to(path)}/ and a COLMAP model in {' or '.join(MODELS)}",
            found="no such model" if folder is None else "no such folder of images",
            todo="copy the missing folder there",
        )
    model = read_model(folder)
    if not model.images:
        raise SceneError(
            folder, expected="registered images", found="none", todo="register the images"
        )
    for image in model.images:
        check_image(folder, image)
    return model


def keep_images(model: Model, names: Collection[str]) -> Model:
    """The model without the other images and their observations; points stay."""
    kept = [i for i, image in enumerate(model.images) if image.name in names]
    rank = np.full(len(model.images), -1, np.int32)
    rank[kept] = np.arange(len(kept), dtype=np.int32)
    images = tuple(model.images[i] for i in kept)
    points = model.points
    return Model(images, points.select_observations(rank[points.track_frame] >= 0, rank))


def make_scene(
    path: Path,
    images: Path,
    model: Model,
    grouped: tuple[Mapping[str, int], Sequence[Period]],
    tests: set[str],
    *,
    rule: str,
    format: str,
) -> Scene:
    """A scene from a model whose images have their periods."""
    periods, table = grouped
    return Scene(
        name=path.resolve().name,
        root=path,
        images_root=images,
        frames=make_frames(model, dict(periods), tests),
        points=model.points,
        periods=tuple(table),
        split_rule=rule,
        format=format,
    )
