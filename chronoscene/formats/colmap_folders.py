"""Plain COLMAP with one folder of images per period: ``images/<period>/...`` and ``sparse/0``.

The first folder of an image name is its period; periods are in the natural order of the folders
(``t2`` before ``t10``), which are also their labels. With ``--period-by``, the dates of the photos
or a table are the periods instead, and images need no folders. As in the ChronoScene format,
``sparse/0/test.txt`` may list the test images, ``sparse/periods.json`` may have labels and dates of
the periods, and ``sparse/world.json`` the world frame.
"""

from __future__ import annotations

from datetime import date
from functools import partial
from pathlib import Path

from chronoscene.colmap.raw_model import FoundModel
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import nerfstudio, wat
from chronoscene.formats.shared import colmap_layout, grouping
from chronoscene.images.exif import capture_times
from chronoscene.images.store import ImageSource, Progress
from chronoscene.io.wording import shown
from chronoscene.scene import Scene

NAME = "colmap-folders"
MARKS = "images/<period>/ and sparse/0/"  # What `matches` looks for

DATES = ("year", "month", "day", "gap:DAYS", "count:N")

PERIOD_BY = ("folder", *DATES, "table:FILE")
"""The first folder of the names (default), dates of the photos, or a CSV file with the columns file
and period."""


def matches(path: Path, model: FoundModel | None) -> bool:
    """Return True if a folder has images in folders and a model, and is not clearly of WAT."""
    if model is None or not colmap_layout.is_in_folders(path / model[1]):
        return False
    if model[0] == nerfstudio.COLMAP and nerfstudio.matches(path):
        return False  # a model that nerfstudio made its file from
    folders, _ = colmap_layout.scan(path / model[1])
    # Where both formats put the folders in the same order, WAT wins; else one must be named.
    return not (wat.matches(path, model) and folders == sorted(folders, key=grouping.natural_key))


def read(path: Path, *, period_by: str = "folder", model: FoundModel | None = None) -> Scene:
    """Read a scene."""
    by_rule, labelled = partial(assign, period_by=period_by), period_by == "folder"
    return colmap_layout.read_scene(path, model, by_rule, NAME, labelled=labelled)


def assign(images: Path, names: list[str], *, period_by: str = "folder") -> colmap_layout.Assigned:
    """Assign periods by the names of the images, or by another rule."""
    kind = period_by.partition(":")[0]
    if period_by.startswith(grouping.TABLE):
        grouped = grouping.group_by_table(names, Path(period_by.removeprefix(grouping.TABLE)))
    elif period_by == "folder":
        labels = {name: _folder(images, name) for name in names}
        order = sorted(set(labels.values()), key=grouping.natural_key)
        grouped = grouping.group_labels(labels, order)
    elif kind in {rule.partition(":")[0] for rule in DATES}:
        grouped = grouping.group_dates(_dates(images, names), period_by)
    else:
        raise grouping.rule_error(period_by, PERIOD_BY)
    return colmap_layout.Assigned(grouped)


def _folder(images: Path, name: str) -> str:
    folder, slash, _ = name.partition("/")
    if not slash:
        raise SceneError(
            images,
            expected="every image in a folder of its period",
            found=repr(name),
            todo=grouping.NAME_PERIODS,
        )
    return folder


def _dates(images: Path, names: list[str]) -> dict[str, date]:
    """Return the day on which each photo was taken."""
    times = capture_times(images, names)
    if lost := [name for name, time in times.items() if time is None]:
        if missing := [name for name in lost if not (images / name).is_file()]:
            raise SceneError(
                images,
                expected="a file for every image of the model",
                found=f"none for {shown(missing)}",
                todo="copy the photos there, or name the periods with --period-by table:FILE",
            )
        raise SceneError(
            images,
            expected="a date for every photo: EXIF DateTimeOriginal, or a file name that begins "
            "with 2023-04-17 or 20230417",
            found=f"none for {len(lost)} of {len(names)}: {shown(lost)}",
            todo="name the periods of all photos with --period-by table:FILE, a CSV file with the "
            "columns file and period",
        )
    return {name: time.date() for name, time in times.items() if time is not None}


def write(
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a scene in this format.

    Images go to the folder of their period. It is named after the period's label where labels are
    names of folders in the order of the periods, else after its id and label.
    """
    return colmap_layout.write_renamed(
        scene,
        out,
        _names(scene),
        texts=(our_format.TEST, our_format.PERIODS, our_format.WORLD),
        image_source=image_source,
        progress=progress,
    )


def losses(scene: Scene) -> list[str]:
    """List the content of a scene that this format cannot hold."""
    return colmap_layout.lost_names(_names(scene))


def _names(scene: Scene) -> dict[str, str]:
    return colmap_layout.new_names(scene, colmap_layout.period_folders(scene.periods), deep=True)
