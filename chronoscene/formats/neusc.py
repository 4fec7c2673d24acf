"""NeuSC / 5Pointz: internet photos of many dates, ``dense/images`` and ``dense/sparse``.

Dates stand at the beginning of the file names (``2012-05-03_...``). Photos whose name begins with
``none`` have no date and are left out, as are those in ``trash.txt``, and those that are not in
``train.txt`` where there is one. Hundreds of dates become periods, by default years.

The authors publish no list of test images; the evaluation in their configuration takes every 10th
image of ``train.txt``. We take the images 0, 10, 20, ... of that list (else of all in name order)
for testing, and train on none of them.

Where ``sparse/periods.json`` and ``sparse/world.json`` of our format are there, which `write` adds,
labels and dates of the years come from the first, and unit and reference system from the second.

Cameras come from the COLMAP model. ``annots/cam_dict.npy`` has them too, but it is a pickle, which
can run any code when it is loaded: it is never opened.

Source: Lin et al., Neural Scene Chronology, CVPR 2023; layout as in ``zju3dv/NeuSC`` at
``66e234a``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from datetime import date
from functools import partial
from itertools import pairwise
from pathlib import Path, PurePosixPath

from chronoscene.colmap.model import Model
from chronoscene.colmap.raw_model import find_model
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared import colmap_layout
from chronoscene.formats.shared.grouping import group_dates
from chronoscene.images.store import ImageSource, Progress
from chronoscene.io.documents import read_text
from chronoscene.scene import Scene
from chronoscene.scene.splits import NameIndex, parse_test_text

NAME = "neusc"
MARKS = "dense/images/ with dates in the names, and dense/sparse/"  # What `matches` looks for

PERIOD_BY = ("year", "month", "day", "gap:DAYS", "count:N")
"""Rules by which dates become periods; by year by default."""

TEST_EVERY = 10

PLACE = ("dense/sparse", "dense/images")
"""Folders of the model and of the images."""

_DAY = re.compile("([0-9]{4})-([0-9]{1,2})-([0-9]{1,2})")

LISTS = ("annots", "")
"""Folders where the lists may be: the scripts write to the second and read from the first."""


def matches(path: Path) -> bool:
    """Return True if a folder has an undistorted model of dated images below ``dense/``."""
    _, images = colmap_layout.scan(path / PLACE[1])
    dated = any(re.match("[0-9]{4}-|none_", name, re.IGNORECASE) for name in images)
    return dated and find_model(path / "dense") is not None


def read(path: Path, *, period_by: str = "year") -> Scene:
    """Read a scene."""
    model, _ = _read_images(path)
    used = _used_names(path, model)
    dates = {name: when for name in used if (when := _date(path, name)) is not None}
    if not dates:
        raise SceneError(
            path / PLACE[1],
            expected="images with a date in their names",
            found="none left by train.txt and trash.txt",
            todo="name images with their dates in train.txt, and not in trash.txt",
        )
    dated = [name for name in used if name in dates]
    scene = our_format.make_scene(
        path,
        path / PLACE[1],
        colmap_layout.keep_images(model, dates.keys()),
        group_dates(dates, period_by),
        set(dated[::TEST_EVERY]),
        rule=f"every {TEST_EVERY}th image of the list (index 0, {TEST_EVERY}, ...)",
        format=NAME,
    )
    if period_by == PERIOD_BY[0] and (path / our_format.PERIODS).exists():
        scene = replace(scene, periods=our_format.read_periods(path, scene.num_periods))
    return replace(scene, world=our_format.read_world(path))


def write(
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a scene for the scripts of NeuSC.

    Names of images begin with the day of their period, the first one of a year or month. Where
    periods are not in different years, one after the other, they become the years 1, 2, ...
    ``annots/train.txt`` lists all images by name. What the scripts make of the model themselves
    (``annots/cam_dict.npy``, semantic maps) is not written.
    """
    names = _written_names(scene)
    readable = partial(colmap_layout.readable_camera, models=("PINHOLE",), loader="NeuSC")
    return colmap_layout.write_renamed(
        scene.with_frames([replace(f, camera=readable(f.camera)) for f in scene.frames]),
        out,
        names,
        texts=(our_format.PERIODS, our_format.WORLD),
        image_source=image_source,
        progress=progress,
        found=PLACE,
        more={"annots/train.txt": "".join(f"{name}\n" for name in sorted(names.values()))},
    )


def losses(scene: Scene) -> list[str]:
    """List the content of a scene that this format, or the loader that it is for, cannot hold."""
    names = _written_names(scene)
    tests, rule = sorted(names.values())[::TEST_EVERY], f"every {TEST_EVERY}th image of all"
    lost = colmap_layout.lost_names(names)
    if not _dated(scene):
        lost.append("periods that are not in different years: they become the years 1, 2, ...")
    lost += colmap_layout.lost_masks(scene)
    return lost + colmap_layout.lost_split(scene, names, tests, rule)


def _written_names(scene: Scene) -> dict[str, str]:
    """Return the name of each image; names that begin with a day of their period already stay.

    Not those in folders: it is the file whose name begins with the day.
    """
    dated = _dated(scene)
    starts = [p.date or "" if dated else f"{p.id + 1:04d}" for p in scene.periods]
    heads = [(starts[f.period], f.name.partition("_")[0]) for f in scene.frames]
    flat = not any("/" in frame.name for frame in scene.frames)
    if flat and all(_DAY.fullmatch(head) and head.startswith(start) for start, head in heads):
        return {f.name: f.name for f in scene.frames}
    days = [start + "-01" * (2 - start.count("-")) for start in starts]
    return {f.name: f"{days[f.period]}_" + f.name.replace("/", "_") for f in scene.frames}


def _dated(scene: Scene) -> bool:
    """Return True if the periods are in different years, one after the other."""
    years = [(period.date or "")[:4] for period in scene.periods]
    return all(years) and all(a < b for a, b in pairwise(years))


def remarks(path: Path) -> list[str]:
    """List the content that does not become part of a scene."""
    model, _ = _read_images(path)
    left_out = len(model.images) - len([n for n in _used_names(path, model) if _date(path, n)])
    found = []
    if left_out:
        found.append(
            f"left out without a date, not in train.txt, or in trash.txt: {left_out} of "
            f"{len(model.images)} images"
        )
    index = NameIndex(image.name for image in model.images)
    for file in ("train.txt", "trash.txt"):
        places = _lists(path, file)
        if len(places) > 1:
            found.append(f"{file} beside {LISTS[0]}/ is not read, as there is one in it")
        entries = parse_test_text(read_text(places[0])) if places else []
        if unknown := sum(not index.find(entry.name) for entry in entries):
            found.append(f"{file} has {unknown} names that match no registered image")
    if (path / "semantic_maps").is_dir():
        found.append("semantic_maps/ (sky, people) is not read")
    return found


def _read_images(path: Path) -> tuple[Model, Path]:
    dense = path / "dense"
    return colmap_layout.read_images(dense, find_model(dense))


def _used_names(path: Path, model: Model) -> list[str]:
    """List registered images as in ``train.txt``, or sorted by name, without the trash."""
    names = [image.name for image in model.images]
    trash = set(_listed(path, "trash.txt", names) or [])
    train = _listed(path, "train.txt", names)
    return [name for name in (names if train is None else train) if name not in trash]


def _lists(path: Path, file: str) -> list[Path]:
    places = (path / folder / file for folder in LISTS)
    return [place for place in places if place.exists()]


def _listed(path: Path, file: str, names: list[str]) -> list[str] | None:
    """Return the registered images that a list names, in its order; None without such a list."""
    places = _lists(path, file)
    if not places:
        return None
    index = NameIndex(names)
    listed: dict[str, None] = {}
    for entry in parse_test_text(read_text(places[0])):
        found = index.find(entry.name)
        if len(found) > 1:
            raise SceneError(
                f"{places[0]}:{entry.line}",
                expected="a name that matches one image",
                found=repr(entry.name),
                todo="write the full name",
            )
        listed.update(dict.fromkeys(found))
    return list(listed)


def _date(path: Path, name: str) -> date | None:
    """Return the date at the beginning of a file name; None for ``none``."""
    prefix = PurePosixPath(name).name.split("_")[0]
    if prefix.lower() == "none":
        return None
    match = _DAY.fullmatch(prefix)
    try:
        if match is not None:
            return date(*map(int, match.groups()))
    except ValueError:
        pass  # no such day; reported below
    raise SceneError(
        path / PLACE[1] / name,
        expected='a file name that begins with a date as in "2012-05-03_", or with "none_"',
        found=repr(prefix),
        todo="rename the image in the model, or list it in trash.txt",
    )
