"""CL-Splats: a COLMAP model with ``day_<n>_`` in the image names, or a rendered level.

- Real scenes: ``images/day_<n>_...`` and ``sparse/0``. The time step is n, 0 for other names; every
  8th image of all in name order is a test image, as in its own loader.
- Rendered levels: ``transforms_train.json`` for the base, and the same in the folders ``add``,
  ``delete``, ``move``, ``multi``, each of which shows one change of the base. All are in one world.
  The base and every change are a period each; with ``--period-by change:add`` the base and that
  change alone. ``transforms_test.json`` holds test images; without any, the default split holds.
  A level has no points but those of ``points3d.ply``.

Source: Ackermann et al., CL-Splats, ICCV 2025; layout as in ``jan-ackermann/cl-splats``.
"""

from __future__ import annotations

import re
from dataclasses import replace
from functools import partial
from pathlib import Path

from chronoscene.colmap.model import PosedImage
from chronoscene.colmap.raw_model import FoundModel
from chronoscene.errors import ConfigError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared import colmap_layout, transforms
from chronoscene.formats.shared.grouping import OPTION, group_labels, natural_key, rule_error
from chronoscene.formats.shared.ply import read_points
from chronoscene.formats.shared.transforms import CameraTable
from chronoscene.images.store import ImageSource, Progress
from chronoscene.io.documents import read_json_document
from chronoscene.scene import Points, Scene
from chronoscene.scene.cameras import PINHOLE_MODELS
from chronoscene.scene.splits import DEFAULT_RULE, TEST_EVERY, default_tests

NAME = "cl-splats"
MARKS = "images/day_<n>_* and sparse/0/, or transforms_train.json here and in add/, move/, ..."
"""Description of the marks that `matches` looks for."""

BASE = "base"
CHANGES = ("add", "delete", "move", "multi")

PERIOD_BY = ("step", *(f"change:{change}" for change in CHANGES))
"""Time steps (default), or the base and one change of a rendered level."""

TRAIN, TEST = "transforms_train.json", "transforms_test.json"
POINTS = "points3d.ply"

_DAY = re.compile(r"day_([0-9]{1,9})_")


def matches(path: Path, model: FoundModel | None) -> bool:
    """Return True if a folder is a real scene or a rendered level."""
    return _is_real(path, model) or _is_level(path)


def _is_real(path: Path, model: FoundModel | None) -> bool:
    return model is not None and any(map(_DAY.match, colmap_layout.scan(path / model[1])[1]))


def _is_level(path: Path) -> bool:
    return (path / TRAIN).is_file() and any((path / c / TRAIN).is_file() for c in CHANGES)


def read(path: Path, *, period_by: str = "step", model: FoundModel | None = None) -> Scene:
    """Read a scene."""
    if (path / TRAIN).exists() and not _is_real(path, model):
        return _read_level(path, period_by)
    return colmap_layout.read_scene(path, model, partial(assign, period_by=period_by), NAME)


def assign(images: Path, names: list[str], *, period_by: str = "step") -> colmap_layout.Assigned:
    """Periods and test images of a real scene by the names of the images."""
    if period_by != "step":
        raise ConfigError(
            OPTION,
            expected="step, as the images are named day_<n>_...",
            found=repr(period_by),
            todo="leave it out: changes are those of rendered levels",
        )
    steps = {name: _step(name) for name in names}
    order = sorted(set(steps.values()), key=natural_key)
    rule = f"every {TEST_EVERY}th image of all in name order (index 0, {TEST_EVERY}, ...)"
    tests = set(sorted(steps)[::TEST_EVERY])
    return colmap_layout.Assigned(group_labels(steps, order), tests, rule)


def _step(name: str) -> str:
    match = _DAY.match(name)
    return f"day {int(match[1]) if match else 0}"


def _read_level(path: Path, period_by: str) -> Scene:
    present = [change for change in CHANGES if (path / change / TRAIN).is_file()]
    rules = ["step", *(f"change:{change}" for change in present)]
    if period_by not in rules:
        raise rule_error(period_by, rules)
    changes = present if period_by == "step" else [period_by.removeprefix("change:")]
    cameras = CameraTable()
    images: list[PosedImage] = []
    labels: dict[str, str] = {}
    tests: set[str] = set()
    for label in (BASE, *changes):
        folder = "" if label == BASE else label
        new = _read_file(path, folder, TRAIN, cameras)
        if (path / folder / TEST).exists():
            held_out = _read_file(path, folder, TEST, cameras)
            tests |= {image.name for image in held_out}
            new += held_out
        images += new
        labels |= {image.name: label for image in new}
    transforms.check_distinct(path, images)
    grouped = group_labels(labels, [BASE, *changes])
    return transforms.make_scene(
        path,
        images,
        grouped,
        tests or default_tests(grouped[0]),
        points=read_points(path / POINTS) if (path / POINTS).exists() else Points.empty(),
        rule=TEST if tests else DEFAULT_RULE,
        format=NAME,
    )


def _read_file(path: Path, folder: str, file: str, cameras: CameraTable) -> list[PosedImage]:
    place = path / folder / file
    data = read_json_document(place)
    shared, images = transforms.shared_keys(data), []
    for i, frame in enumerate(transforms.read_frames(place, data)):
        where = f"{place}: frames[{i}]"
        name = transforms.image_name(where, path, folder, frame.get("file_path"))
        world_from_cam = transforms.matrix(where, frame.get("transform_matrix"))
        pose = transforms.pose_from_opengl(where, world_from_cam)
        camera = cameras.camera(where, transforms.frame_keys(shared, frame), path / name)
        images.append(PosedImage(0, name, camera, pose))
    return images


def remarks(path: Path) -> list[str]:
    """List the content that does not become part of a scene."""
    if _is_level(path) and not (path / POINTS).exists():
        return [f"the level has no {POINTS}: the scene has no points"]
    return []


def write(
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a real scene for the loader of CL-Splats.

    Images are directly in ``images/``, and their names begin with ``day_<period>_``.
    """
    readable = partial(colmap_layout.readable_camera, models=PINHOLE_MODELS, loader="CL-Splats")
    return colmap_layout.write_renamed(
        scene.with_frames([replace(f, camera=readable(f.camera)) for f in scene.frames]),
        out,
        _written_names(scene),
        texts=(our_format.PERIODS, our_format.WORLD),
        image_source=image_source,
        progress=progress,
    )


def losses(scene: Scene) -> list[str]:
    """List the content of a scene that this format, or the loader that it is for, cannot hold."""
    names = _written_names(scene)
    tests, rule = sorted(names.values())[::TEST_EVERY], f"every {TEST_EVERY}th image of all"
    return [
        *colmap_layout.lost_names(names),
        *colmap_layout.lost_masks(scene),
        *colmap_layout.lost_split(scene, names, tests, rule),
    ]


def _written_names(scene: Scene) -> dict[str, str]:
    """Return the name of each image; names that contain the periods already stay."""
    steps = {(f.period, _step(f.name)) for f in scene.frames if "/" not in f.name}
    ordered = [step for _, step in sorted(steps)]
    named = all(_DAY.match(f.name) and "/" not in f.name for f in scene.frames)
    is_table = ordered == sorted(set(ordered), key=natural_key)  # one period for each step
    if named and len(steps) == scene.num_periods and is_table:
        return {f.name: f.name for f in scene.frames}
    return {f.name: f"day_{f.period}_" + f.name.replace("/", "_") for f in scene.frames}
