"""What the writers share whose result is a COLMAP model and images with new names.

All that is known of a period in such formats is a part of the image names: a folder, or a prefix.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from chronoscene.colmap.model import write_model
from chronoscene.errors import SceneError
from chronoscene.formats.chronoscene import MODEL, TEST, check_writable_name
from chronoscene.formats.shared.grouping import label_date, natural_key
from chronoscene.formats.shared.writing import (
    ImageSource,
    Progress,
    place_image,
    renamed,
    staged_folder,
)
from chronoscene.scene import Camera, Period, Scene, WorldFrame


def write_renamed(
    scene: Scene,
    out: Path,
    names: Mapping[str, str],
    *,
    test_list: bool,
    image_source: ImageSource,
    progress: Progress | None,
) -> Path:
    """Write ``images/`` and ``sparse/0`` with other image names; complete or not at all.

    Args:
        scene: Any scene; its images are found by the old names.
        out: Folder that does not exist yet, or is empty.
        names: New name of each image.
        test_list: Whether to write ``sparse/0/test.txt``.
        image_source: What to do with the images; see `IMAGE_SOURCES`.
        progress: Called after each image.

    Raises:
        SceneError: If ``out`` is in use, an image is missing, or two new names are equal.
    """
    if len(set(names.values())) < len(names):
        raise SceneError(
            out,
            expected="image names that differ when / becomes _",
            found="equal ones",
            todo="rename images",
        )
    new = renamed(scene, names)
    for frame in new.frames:
        check_writable_name(out, frame)
    with staged_folder(out) as staged:
        (staged / MODEL).mkdir(parents=True)
        write_model(staged / MODEL, new.frames, new.points)
        if test_list:
            tests = "".join(f"{f.name}\n" for f in new.frames if f.split == "test")
            (staged / TEST).write_text(tests, encoding="utf-8", newline="\n")
        (staged / "images").mkdir()
        for done, frame in enumerate(scene.frames, start=1):
            if image_source != "none":
                target = staged / "images" / names[frame.name]
                place_image(scene.image_path(frame), target, image_source)
            if progress is not None:
                progress(done, len(scene.frames))
    return out


def period_folders(
    periods: tuple[Period, ...], order: Callable[[str], Any] = natural_key
) -> list[str]:
    """A folder for each period, such that sorted folders are in the order of the periods.

    Args:
        periods: Of the scene.
        order: Key by which a reader sorts the folders.
    """
    labels = [period.label for period in periods]
    plain = all(re.fullmatch(r"\w[\w.+ -]*(?<! )", label) for label in labels)
    if plain and labels == sorted(set(labels), key=order):
        return labels
    digits = len(str(len(periods) - 1))
    return [f"{p.id:0{digits}d}_" + re.sub(r"[^\w.+-]+", "-", p.label) for p in periods]


def new_names(scene: Scene, folders: list[str], *, deep: bool) -> dict[str, str]:
    """Name of each image in the folder of its period; names that are all there stay.

    Args:
        scene: Any scene.
        folders: Of its periods.
        deep: Whether there may be folders in the folder of a period.
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


def as_pinhole(camera: Camera) -> Camera:
    """The same camera as a PINHOLE; it must have no distortion."""
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    return replace(camera, model="PINHOLE", params=(fx, fy, cx, cy))


def lost_labels(scene: Scene, labels: list[str]) -> list[str]:
    """What is lost where a period has no more than a label, and that only of a certain form."""
    lost = []
    if labels != [period.label for period in scene.periods]:
        lost.append(f"the labels of the periods as they are (but: {', '.join(labels[:8])})")
    if any(p.date != label_date(label) for p, label in zip(scene.periods, labels, strict=True)):
        lost.append("the dates of the periods")
    if scene.world != WorldFrame():
        lost.append("unit and reference system of the world")
    return lost


def lost_names(names: Mapping[str, str]) -> list[str]:
    """What to say where names change, with which anything else may refer to the images."""
    if all(new == old for old, new in names.items()):
        return []
    return ["these image names, which get the mark of their period"]


def lost_split(scene: Scene, tests: set[str], rule: str) -> list[str]:
    """What to say where a loader takes its own test images, whatever the split of the scene.

    Args:
        scene: Any scene.
        tests: Names, in the scene, of the images that it takes.
        rule: Which those are, in words.
    """
    if {f.name for f in scene.select(split="test")} == tests:
        return []
    return [f"this split, as its loader takes {rule}"]
