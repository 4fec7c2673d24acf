"""Scenes from one format to another, and what is lost on the way."""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from chronoscene.checks import check_choice
from chronoscene.formats import load_format, read_scene, writable_formats
from chronoscene.images.store import ImageSource, Progress
from chronoscene.io.staging import check_outside
from chronoscene.scene import Scene
from chronoscene.scene.splits import IMAGE_SUFFIXES


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """A conversion that was carried out."""

    scene: Scene
    """As it was read."""
    out: Path
    target: str
    """Name of the format written."""
    warnings: tuple[str, ...]
    """What the result lacks, or what stands in the way of using it."""


def convert(
    source: Path,
    out: Path,
    *,
    source_format: str | None = None,
    target: str = "chronoscene",
    period_by: str | None = None,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> Conversion:
    """Read a scene in any format and write it in another; the source is left alone.

    Args:
        source: Folder of one scene.
        out: Folder that does not exist yet, or is empty; not inside of ``source``.
        source_format: None to find out.
        target: A format that can be written.
        period_by: How images are grouped into periods, where the source leaves a choice.
        image_source: Copy or link the images.
        progress: Called after each image.

    Raises:
        SceneError: If the source is damaged, or ``out`` is in use.
        ConfigError: If a format or grouping does not exist, or ``out`` is inside of ``source``.
    """
    check_choice("--to", target, writable_formats())
    check_outside(out, [source])
    scene = read_scene(source, format=source_format, period_by=period_by)
    warnings = (*remarks_on(scene), *losses(scene, target), *obstacles(scene))
    load_format(target).write(scene, out, image_source=image_source, progress=progress)
    return Conversion(scene, out, target, warnings)


def remarks_on(scene: Scene) -> list[str]:
    """What the source has that we do not read."""
    module = load_format(scene.format)
    said = list(module.remarks(scene.root)) if hasattr(module, "remarks") else []
    if scene.images_root != scene.root and (count := _unused_images(scene)):
        where = scene.images_root.relative_to(scene.root)
        said.append(f"{count} image files in {where}/ are not in the scene, and not converted")
    return said


def _unused_images(scene: Scene) -> int:
    """Number of image files below the folder of images that no frame uses."""
    used = {os.path.normpath(scene.image_path(frame)) for frame in scene.frames}
    found = (
        os.path.normpath(os.path.join(folder, file))
        for folder, _, files in os.walk(scene.images_root)
        for file in files
        if file.lower().endswith(IMAGE_SUFFIXES)
    )
    return sum(path not in used for path in found)


def losses(scene: Scene, target: str) -> list[str]:
    """What a scene has that a format cannot hold."""
    module = load_format(target)
    lost = module.losses(scene) if hasattr(module, "losses") else []
    return [f"{target} has no place for {item}" for item in lost]


def obstacles(scene: Scene) -> list[str]:
    """Why a benchmark would refuse the scene as it is."""
    found = []
    cameras = {f.camera.camera_id: f.camera for f in scene.frames}.values()
    distorted = sorted({camera.model for camera in cameras if not camera.is_pinhole})
    if distorted:
        found.append(
            f"cameras have distortion ({', '.join(distorted)}), which is kept; methods need "
            "images without: chronoscene undistort"
        )
    points = scene.points
    if not len(points):
        found.append("the scene has no points, which methods start from; triangulate some")
    elif not np.diff(points.track_start).any():
        found.append(
            "no point is observed by an image, and methods start from observed points only: "
            "colmap point_triangulator makes such points for known poses"
        )
    if not scene.select(split="test"):
        found.append("there are no test images: chronoscene split chooses some")
    return found
