"""The ChronoScene format: ``images/``, a COLMAP model, periods and split. See DATASET.md."""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np

from chronoscene.colmap.model import Model, PosedImage, read_model, write_model
from chronoscene.colmap.raw_model import find_model
from chronoscene.errors import SceneError
from chronoscene.formats.shared.json_values import (
    parse_periods,
    parse_world,
    period_items,
    world_item,
)
from chronoscene.images.masks import MASKS, find_masks
from chronoscene.images.store import ImageSource, Progress, place_images
from chronoscene.io.documents import read_json_document, read_text
from chronoscene.io.staging import leads_out, staged_folder
from chronoscene.scene import Frame, Period, Scene, WorldFrame, splits
from chronoscene.scene.geometry import is_rotation

NAME = "chronoscene"
MARKS = SPLIT = splits.SPLIT
TEST = "sparse/0/test.txt"
MODEL = "sparse/0"
PERIODS = "sparse/periods.json"
WORLD = "sparse/world.json"
TEXTS = (SPLIT, TEST, PERIODS, WORLD)

MAX_COORDINATE = 1e100  # Larger than any world; squares and sums of such numbers are still finite

NOT_RIGID = 1e-6
"""Deviation from a rotation beyond which a pose is refused; COLMAP's are exact to rounding."""

MAX_PERIODS = 100_000  # Far more than any real scene has: a mistaken id must not fill the memory


def matches(path: Path) -> bool:
    """Return True if a folder is meant to be of this format."""
    return (path / SPLIT).is_file()


def read(path: Path, *, model: Model | None = None, empty_periods: bool = False) -> Scene:
    """Read a scene; stops at the first problem.

    Args:
        path: Folder of the scene.
        model: Its COLMAP model, where that was read before.
        empty_periods: Accept periods without an image in the model.
    """
    entries, problems = splits.parse_split_text(read_text(path / SPLIT))
    raise_first(path / SPLIT, problems)
    model = model or _read_model(path)
    for image in model.images:
        check_image(path / MODEL, image)
    names = [image.name for image in model.images]
    periods, problems = splits.assign_periods(names, entries)
    raise_first(path / SPLIT, (p for p in problems if p.kind != "empty" or not empty_periods))
    tests, rule = read_tests(path, names, periods)
    table = read_periods(path, 1 + max(entry.period for entry in entries))
    grouped = {name: periods[name] for name in names}, table
    scene = make_scene(path, path / "images", model, grouped, tests, rule=rule, format=NAME)
    return replace(scene, world=read_world(path))


def _read_model(path: Path) -> Model:
    """Read the model, which this format has in one place only."""
    found = find_model(path)
    if found is not None and found[0] != MODEL:
        raise SceneError(
            path / MODEL,
            expected="the COLMAP model",
            found=f"one in {found[0] or 'the scene folder'}, of the images in {found[1]}",
            todo=f"move its files to {MODEL}"
            + (", and the images to images" * (found[1] != "images")),
        )
    return read_model(path / MODEL)


def others(path: Path) -> list[str]:
    """List the files and folders in a folder that are not part of the format."""
    names = {p.name + "/" * p.is_dir() for p in path.iterdir()}
    return sorted(names - {"images/", "sparse/", f"{MASKS}/"})


def raise_first(path: Path, problems: Iterable[splits.Problem]) -> None:
    """Raise the first problem that makes a scene unreadable."""
    for problem in problems:
        if problem.kind in splits.FATAL:
            raise problem.error(path)


def check_image(place: Path, image: PosedImage) -> None:
    """Refuse an image whose name, pose or camera no method could use."""
    check_name(place, image.name)
    camera, pose = image.camera, image.cam_from_world
    wrong = None
    if not (np.abs(pose) < MAX_COORDINATE).all():
        wrong = f"a finite pose of {image.name!r}", "NaN, infinity, or absurdly large numbers"
    elif not is_rotation(pose[:3, :3], NOT_RIGID):
        found = "a different matrix, from a quaternion that is too large or too small"
        wrong = f"a rotation in the pose of {image.name!r}", found
    if wrong is not None:
        todo = "leave it out (chronoscene edit SCENE OUT --drop IMAGE), or register it again"
        raise SceneError(place, expected=wrong[0], found=wrong[1], todo=todo)
    if not camera.is_usable:
        raise SceneError(
            place,
            expected=f"a camera {camera.camera_id} with a plausible size, positive focal lengths "
            "and finite parameters",
            found=f"{camera.model} {camera.width} x {camera.height}, {camera.params}",
            todo="correct the camera",
        )


def check_name(place: Path, name: str) -> None:
    """Refuse an image name that leads out of ``images/``."""
    if leads_out(name):
        raise SceneError(
            place,
            expected="image names below images/",
            found=repr(name),
            todo="rename the image in the model",
        )


def make_scene(
    path: Path,
    images: Path,
    model: Model,
    grouped: tuple[dict[str, int], tuple[Period, ...]],
    tests: set[str],
    *,
    rule: str,
    format: str,
) -> Scene:
    """Make a scene of a model whose images have their periods."""
    periods, table = grouped
    return Scene(
        name=path.resolve().name,
        root=path,
        images_root=images,
        frames=tuple(
            Frame(
                name=image.name,
                image_id=image.image_id,
                camera=image.camera,
                cam_from_world=image.cam_from_world,
                period=periods[image.name],
                split=splits.split_of(image.name, tests),
            )
            for image in model.images
        ),
        points=model.points,
        periods=table,
        split_rule=rule,
        format=format,
        masks=find_masks(images.parent, periods),
    )


def read_tests(path: Path, names: list[str], periods: dict[str, int]) -> tuple[set[str], str]:
    """Return the names of the test images, and the rule that chose them in words."""
    if not (path / TEST).exists():
        return splits.default_tests(periods), splits.DEFAULT_RULE
    entries = splits.parse_test_text(read_text(path / TEST))
    tests, problems = splits.assign_tests(names, entries)
    raise_first(path / TEST, problems)
    return tests, TEST


def read_periods(path: Path, count: int) -> tuple[Period, ...]:
    """Read labels and dates from ``periods.json``, or the ids where the file is absent.

    Raises:
        SceneError: If there are more than `MAX_PERIODS`, or the file is damaged or does not have
            the periods 0 to ``count - 1``.
    """
    if count > MAX_PERIODS:
        raise SceneError(
            path / SPLIT,
            expected=f"at most {MAX_PERIODS} periods",
            found=f"{count}",
            todo="number the periods 0, 1, ...; labels and dates go to sparse/periods.json",
        )
    if not (path / PERIODS).exists():
        return tuple(Period(i, str(i)) for i in range(count))
    return parse_periods(path / PERIODS, read_json_document(path / PERIODS, list), count)


def read_world(path: Path) -> WorldFrame:
    """Read unit and reference system from ``world.json``; unknown where the file is absent."""
    place = path / WORLD
    if not place.exists():
        return WorldFrame()
    return parse_world(place, read_json_document(place))


def write(
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a scene in this format.

    Args:
        scene: Any scene, of whatever format.
        out: Folder that does not exist yet, or is empty.
        image_source: What to do with the images; see `IMAGE_SOURCES`.
        progress: Called after each image.
    """
    for frame in scene.frames:
        check_writable_name(out, frame)
    with staged_folder(out) as staged:
        write_texts(scene, staged)
        place_images(scene, staged / "images", image_source=image_source, progress=progress)
    return out


def check_writable_name(place: Path, frame: Frame) -> None:
    """Refuse a name that would leave the folder or that one line of text cannot hold."""
    check_name(place, frame.name)
    entries, _ = splits.parse_split_text(splits.format_split_text({frame.name: frame.period}))
    if [(entry.name, entry.period) for entry in entries] != [(frame.name, frame.period)]:
        raise SceneError(
            place,
            expected="image names without line breaks and without leading or trailing blanks",
            found=repr(frame.name),
            todo="rename the image",
        )


def write_texts(
    scene: Scene, root: Path, texts: Collection[str] = TEXTS, *, model: str = MODEL
) -> None:
    """Write the model and some texts of the format, all but the images, into an existing folder."""
    (root / model).mkdir(parents=True)
    write_model(root / model, scene.frames, scene.points)
    tests = [f.name for f in scene.frames if f.split == "test"]
    files = {
        SPLIT: splits.format_split_text({f.name: f.period for f in scene.frames}),
        TEST: "".join(f"{name}\n" for name in tests),
        PERIODS: json.dumps(period_items(scene.periods), indent=1, ensure_ascii=False) + "\n",
        WORLD: json.dumps(world_item(scene.world)) + "\n",
    }
    for name in texts:
        (root / name).parent.mkdir(exist_ok=True)
        (root / name).write_text(files[name], encoding="utf-8", newline="\n")
