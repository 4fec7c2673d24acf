"""Reading and writing of formats that are a COLMAP model beside a folder of images.

In such formats a period is a part of the image names: a folder, or a prefix. Writers give the
images new names.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.colmap.model import Model, read_model
from chronoscene.colmap.raw_model import FoundModel
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared.grouping import Grouped, natural_key
from chronoscene.images.store import ImageSource, Progress, place_images
from chronoscene.io.staging import staged_folder
from chronoscene.scene import Camera, Period, Scene
from chronoscene.scene.cameras import as_pinhole, way_to_pinhole
from chronoscene.scene.splits import IMAGE_SUFFIXES


@dataclass(frozen=True, slots=True)
class Assigned:
    """Periods and tests that a format assigns to the images of a model by their names."""

    grouped: Grouped
    tests: set[str] | None = None
    """None where they are those of the ChronoScene format: a list in a file, or the default."""
    rule: str = ""
    """The rule that chose ``tests``, in words."""


def scan(folder: Path) -> tuple[list[str], list[str]]:
    """List the folders and the images directly in a folder, sorted.

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


def is_in_folders(images: Path) -> bool:
    """Return True if there are folders of images, and no image beside them."""
    folders, files = scan(images)
    return bool(folders) and not files


def read_scene(
    path: Path,
    model: FoundModel | None,
    assign: Callable[[Path, list[str]], Assigned],
    format: str,
    *,
    labelled: bool = True,
) -> Scene:
    """Read a scene whose periods follow from the names of its images.

    Args:
        path: Folder of the scene.
        model: Its COLMAP model, if there is one.
        assign: Periods and tests of the images with these names, which are in this folder.
        format: Name of the format.
        labelled: False if ``sparse/periods.json`` is about other periods.

    Raises:
        SceneError: If the model is missing or damaged.
    """
    posed, images = read_images(path, model)
    names = [image.name for image in posed.images]
    assigned = assign(images, names)
    tests, rule = assigned.tests, assigned.rule
    if tests is None:
        tests, rule = our_format.read_tests(path, names, assigned.grouped[0])
    scene = our_format.make_scene(
        path, images, posed, assigned.grouped, tests, rule=rule, format=format
    )
    if labelled and (path / our_format.PERIODS).exists():
        scene = replace(scene, periods=our_format.read_periods(path, scene.num_periods))
    return replace(scene, world=our_format.read_world(path))


def read_images(path: Path, found: FoundModel | None) -> tuple[Model, Path]:
    """Read and check the model of a scene; also the folder of its images.

    Raises:
        SceneError: If it is missing or empty, or has an unusable name, pose or camera.
    """
    images = "images" if found is None else found[1]
    if found is None or not (path / images).is_dir():
        raise SceneError(
            path,
            expected=f"{images}/ and a COLMAP model, in {our_format.MODEL} for example",
            found="no model" if found is None else f"no folder {images}/",
            todo="copy what is missing there",
        )
    folder = path / found[0]
    model = read_model(folder)
    if not model.images:
        raise SceneError(
            folder,
            expected="registered images",
            found="none",
            todo="register the photos (chronoscene register)",
        )
    for image in model.images:
        our_format.check_image(folder, image)
    return model, path / images


def keep_images(model: Model, names: Collection[str]) -> Model:
    """Drop the other images of a model and their observations; points stay."""
    kept = [i for i, image in enumerate(model.images) if image.name in names]
    rank = np.full(len(model.images), -1, np.int32)
    rank[kept] = np.arange(len(kept), dtype=np.int32)
    images = tuple(model.images[i] for i in kept)
    points = model.points
    return Model(images, points.select_observations(rank[points.track_frame] >= 0, rank))


def write_renamed(
    scene: Scene,
    out: Path,
    names: Mapping[str, str],
    *,
    texts: Collection[str],
    image_source: ImageSource,
    progress: Progress | None,
    found: FoundModel = (our_format.MODEL, "images"),
    more: Mapping[str, str] | None = None,
) -> Path:
    """Write images and a model with other image names; complete or not at all.

    Args:
        scene: What to write.
        out: Folder that does not exist yet, or is empty.
        names: Old to new names of images.
        texts: Those of `our_format.TEXTS` to write.
        image_source: As for `chronoscene.formats.chronoscene`, like ``progress``.
        progress: Called after each image.
        found: Folders of the model and of the images.
        more: Content of further text files by their place.

    Raises:
        SceneError: If ``out`` is in use, an image is missing, or two new names are equal.
    """
    olds: dict[str, str] = {}
    for old, name in names.items():
        if (other := olds.setdefault(name, old)) != old:
            raise SceneError(
                out,
                expected="distinct image names",
                found=f"{other!r} and {old!r}, both {name!r}",
                todo="rename one of the images (chronoscene edit --rename OLD=NEW)",
            )
    new = _renamed(scene, names)
    for frame in new.frames:
        our_format.check_writable_name(out, frame)
    with staged_folder(out) as staged:
        our_format.write_texts(new, staged, texts, model=found[0])
        for place, text in (more or {}).items():
            (staged / place).parent.mkdir(exist_ok=True)
            (staged / place).write_text(text, encoding="utf-8", newline="\n")
        (staged / found[1]).mkdir()
        place_images(
            scene, staged / found[1], names=names, image_source=image_source, progress=progress
        )
    return out


def readable_camera(camera: Camera, models: Collection[str], loader: str) -> Camera:
    """Return the same camera in a model that a loader reads, one of some without distortion.

    Raises:
        SceneError: If the camera has distortion.
    """
    if camera.model in models:
        return camera
    if camera.is_pinhole:
        return as_pinhole(camera)
    raise SceneError(
        f"camera {camera.camera_id}",
        expected=f"a camera that {loader} reads: {', '.join(models)}",
        found=camera.model,
        todo=f"{way_to_pinhole(camera)} first",
    )


def _renamed(scene: Scene, names: Mapping[str, str]) -> Scene:
    """Rename the images of a scene: frames are sorted again, and tracks follow them.

    The files keep their names, so `Scene.image_path` of the result is invalid.
    """
    new = [replace(frame, name=names[frame.name]) for frame in scene.frames]
    order = sorted(range(len(new)), key=lambda i: new[i].name)
    rank = np.empty(len(new), np.int32)
    rank[order] = np.arange(len(new), dtype=np.int32)
    points = replace(scene.points, track_frame=rank[scene.points.track_frame])
    return replace(scene, frames=tuple(new[i] for i in order), points=points)


def period_folders(
    periods: tuple[Period, ...], order: Callable[[str], Any] = natural_key
) -> list[str]:
    """Name a folder for each period, so that ``order`` sorts them as the periods."""
    labels = [period.label for period in periods]
    plain = all(re.fullmatch(r"\w[\w.+ -]*(?<! )", label) for label in labels)
    if plain and labels == sorted(set(labels), key=order):
        return labels
    digits = len(str(len(periods) - 1))
    return [f"{p.id:0{digits}d}_" + re.sub(r"[^\w.+-]+", "-", p.label) for p in periods]


def new_names(scene: Scene, folders: list[str], *, deep: bool) -> dict[str, str]:
    """Name each image in the folder of its period; unchanged if all are there already.

    With ``deep``, the folder of a period may have subfolders.
    """
    old = {f.name: folders[f.period] for f in scene.frames}
    fits = all(
        name.startswith(f"{folder}/") and (deep or name.count("/") == 1)
        for name, folder in old.items()
    )
    if fits:
        return {name: name for name in old}
    flat = {name: name if deep else name.replace("/", "_") for name in old}
    return {name: f"{folder}/{flat[name]}" for name, folder in old.items()}


def lost_names(names: Mapping[str, str]) -> list[str]:
    """Losses of a format that changes image names, by which other files may refer to them."""
    if all(new == old for old, new in names.items()):
        return []
    return ["the image names, to which the period is added"]


def lost_masks(scene: Scene) -> list[str]:
    """Losses of a format whose loader reads no masks; they are written all the same."""
    return ["masks, which its loader does not read"] if scene.masks else []


def lost_split(
    scene: Scene, names: Mapping[str, str], tests: Collection[str], rule: str
) -> list[str]:
    """Losses of a format whose loader chooses ``tests`` of the new names, by a rule in words."""
    if {names[f.name] for f in scene.select(split="test")} == set(tests):
        return []
    return [f"the split, because its loader takes {rule}"]
