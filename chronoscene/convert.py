"""Conversion of scenes between formats, and what each conversion loses."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path

from chronoscene.checks import check_choice
from chronoscene.formats import detect, load_format, writable_formats
from chronoscene.formats.chronoscene import TEST
from chronoscene.images.store import ImageSource, Progress
from chronoscene.io.staging import check_outside
from chronoscene.scene import Scene
from chronoscene.scene.cameras import way_to_pinhole
from chronoscene.scene.splits import IMAGE_SUFFIXES


@dataclass(frozen=True, slots=True, eq=False)
class Conversion:
    """The result of a conversion."""

    scene: Scene
    """The scene that was read."""
    out: Path
    target: str
    """Name of the format written."""
    warnings: tuple[str, ...]
    """Losses, and reasons that prevent the use of the result."""


def convert(
    source: Path,
    out: Path,
    *,
    source_format: str | None = None,
    target: str = "chronoscene",
    period_by: str | None = None,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
    check: Callable[[Scene], object] | None = None,
    add: Callable[[Scene], Collection[str]] | None = None,
) -> Conversion:
    """Read a scene in any format and write it in another; the source is not changed.

    Args:
        source: Folder of one scene.
        out: Folder that does not exist yet, or is empty; not inside of ``source``.
        source_format: None to detect it.
        target: A format that can be written.
        period_by: How images are grouped into periods, where the source leaves a choice.
        image_source: Copy or link the images.
        progress: Called after each image.
        check: Called with the scene before anything is written; what it raises ends the conversion.
        add: Called with the scene after it is written; returns names of files of the source that it
            writes into ``out`` itself.

    Raises:
        SceneError: If the source is damaged, or ``out`` is in use.
        ConfigError: If a format or grouping does not exist, or ``out`` is inside of ``source``.
    """
    check_choice("--to", target, writable_formats())
    check_outside(out, [source])
    detected = detect(source, format=source_format, period_by=period_by)
    scene = detected.read()
    if check is not None:
        check(scene)
    load_format(target).write(scene, out, image_source=image_source, progress=progress)
    notes = (*detected.notes, *remarks_on(scene, () if add is None else add(scene)))
    warnings = (*notes, *losses(scene, target), *obstacles(scene))
    return Conversion(scene, out, target, warnings)


def remarks_on(scene: Scene, written: Collection[str] = ()) -> list[str]:
    """List the content of the source that is not read, but for files that are written anew."""
    module = load_format(scene.format)
    found = list(module.remarks(scene.root)) if hasattr(module, "remarks") else []
    others = module.others(scene.root) if hasattr(module, "others") else []
    if left := [name for name in others if name not in written]:
        found.append(f"not part of the format, and not converted: {', '.join(left)}")
    found += unread_tests(scene.root, scene.split_rule)
    if scene.images_root != scene.root and (count := _unused_images(scene)):
        where = scene.images_root.relative_to(scene.root)
        found.append(
            f"{count} image files in {where}/ are not part of the scene and were not converted"
        )
    return found


def unread_tests(root: Path, rule: str) -> list[str]:
    """Tell that a list of test images is there, where the format has another rule."""
    if rule == TEST or not (root / TEST).exists():
        return []
    return [f"{TEST} is not read; split: {rule}"]


def _unused_images(scene: Scene) -> int:
    """Count the files in the image folder that no frame uses."""
    used = {os.path.normpath(scene.image_path(frame)) for frame in scene.frames}
    found = (
        os.path.normpath(os.path.join(folder, file))
        for folder, _, files in os.walk(scene.images_root)
        for file in files
        if file.lower().endswith(IMAGE_SUFFIXES)
    )
    return sum(path not in used for path in found)


def losses(scene: Scene, target: str) -> list[str]:
    """List the content of a scene that a format cannot store."""
    module = load_format(target)
    lost = module.losses(scene) if hasattr(module, "losses") else []
    return [f"{target} cannot store {item}" for item in lost]


def obstacles(scene: Scene) -> list[str]:
    """List the reasons for which a benchmark would refuse the scene as it is."""
    found = []
    cameras = {f.camera.camera_id: f.camera for f in scene.frames}.values()
    ways = {camera.model: way_to_pinhole(camera) for camera in cameras if not camera.is_pinhole}
    for way in sorted(set(ways.values())):
        models = ", ".join(sorted(model for model in ways if ways[model] == way))
        found.append(
            f"cameras have lens distortion ({models}), which is kept; methods need undistorted "
            f"images: {way}"
        )
    if not len(scene.points):
        found.append(
            "the scene has no points, and methods start from points: run chronoscene triangulate"
        )
    if not scene.select(split="train"):
        found.append(
            "there are no training images; chronoscene split chooses fewer test images, or holds "
            "out whole periods (--strategy periods) where each has a single image"
        )
    if not scene.select(split="test"):
        found.append("there are no test images; chronoscene split chooses some")
    return found
