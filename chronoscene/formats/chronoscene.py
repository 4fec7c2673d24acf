"""The ChronoScene format: ``images/``, a COLMAP model, periods and split. See DATASET.md."""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterable
from datetime import date
from pathlib import Path, PurePosixPath, PureWindowsPath
from typing import Any, Literal

import numpy as np

from chronoscene.checks import check_choice
from chronoscene.colmap import Model, PosedImage, read_model, write_model
from chronoscene.errors import SceneError
from chronoscene.scene import Frame, Period, Scene, WorldFrame
from chronoscene.splits import (
    DEFAULT_RULE,
    FATAL,
    Problem,
    assign_periods,
    assign_tests,
    default_tests,
    format_split_text,
    parse_split_text,
    parse_test_text,
    read_text,
    split_of,
)

NAME = "chronoscene"
MARKS = "sparse/split.txt"
"""What `matches` looks for."""

SPLIT = "sparse/split.txt"
TEST = "sparse/0/test.txt"
MODEL = "sparse/0"
PERIODS = "sparse/periods.json"
WORLD = "sparse/world.json"

MOST_PERIODS = 100_000
"""Far beyond any real scene: more come from a mistaken id, and would fill the memory."""

ImageSource = Literal["copy", "link", "none"]


def matches(path: Path) -> bool:
    """Whether a folder is meant to be of this format."""
    return (path / SPLIT).is_file()


def read(path: Path) -> Scene:
    """Read a scene; stops at the first problem.

    Raises:
        SceneError: If a file is missing, damaged or contradicts another.
    """
    path = Path(path)
    entries, problems = parse_split_text(read_text(path / SPLIT))
    raise_first(path / SPLIT, problems)
    model = read_model(path / MODEL)
    names = [image.name for image in model.images]
    for image in model.images:
        check_image(path / MODEL, image)
    periods, problems = assign_periods(names, entries)
    raise_first(path / SPLIT, problems)
    tests, rule = read_tests(path, names, periods)
    return Scene(
        name=path.resolve().name,
        root=path,
        images_root=path / "images",
        frames=make_frames(model, periods, tests),
        points=model.points,
        periods=read_periods(path, 1 + max(periods.values())),
        split_rule=rule,
        format=NAME,
        world=read_world(path),
    )


def raise_first(path: Path, problems: Iterable[Problem]) -> None:
    """Raise the first problem that makes a scene unreadable."""
    for problem in problems:
        if problem.kind in FATAL:
            raise problem.error(path)


def check_image(place: Path, image: PosedImage) -> None:
    """Refuse an image that no method could use: its name, its pose, its camera."""
    check_name(place, image.name)
    camera = image.camera
    if not np.isfinite(image.cam_from_world).all():
        raise SceneError(
            place,
            expected=f"a finite pose of {image.name!r}",
            found="NaN or infinity",
            todo="remove the image from the model, or register it again",
        )
    focal = camera.K[[0, 1], [0, 1]] if camera.params else np.zeros(2)
    if min(camera.width, camera.height) < 1 or not (np.isfinite(focal) & (focal > 0)).all():
        raise SceneError(
            place,
            expected=f"a camera {camera.camera_id} with positive size and focal length",
            found=f"{camera.width} x {camera.height}, {camera.params}",
            todo="correct the camera",
        )


def check_name(place: Path, name: str) -> None:
    """Refuse an image name that leads out of ``images/``."""
    parts = PurePosixPath(name).parts
    if not parts or ".." in parts or name.startswith("/") or PureWindowsPath(name).drive:
        raise SceneError(
            place,
            expected="image names below images/",
            found=repr(name),
            todo="rename the image in the model",
        )


def make_frames(model: Model, periods: dict[str, int], tests: set[str]) -> tuple[Frame, ...]:
    """Frames of the registered images, in their order."""
    return tuple(
        Frame(
            name=image.name,
            image_id=image.image_id,
            camera=image.camera,
            cam_from_world=image.cam_from_world,
            period=periods[image.name],
            split=split_of(image.name, tests),
        )
        for image in model.images
    )


def read_tests(path: Path, names: list[str], periods: dict[str, int]) -> tuple[set[str], str]:
    """Names of the test images, and the rule that chose them in words."""
    if not (path / TEST).exists():
        return default_tests(periods), DEFAULT_RULE
    tests, problems = assign_tests(names, parse_test_text(read_text(path / TEST)))
    raise_first(path / TEST, problems)
    return tests, TEST


def read_periods(path: Path, count: int) -> tuple[Period, ...]:
    """Labels and dates from ``periods.json``, or the ids where the file is absent.

    Raises:
        SceneError: If there are more than `MOST_PERIODS`, or the file is damaged or does not have
            the periods 0 to ``count - 1``.
    """
    if count > MOST_PERIODS:
        raise SceneError(
            path / SPLIT,
            expected=f"at most {MOST_PERIODS} periods",
            found=f"{count}",
            todo="number the periods 0, 1, ...; labels and dates go to sparse/periods.json",
        )
    if not (path / PERIODS).exists():
        return tuple(Period(i, str(i)) for i in range(count))
    items = _read_json(path / PERIODS, list)
    if [item.get("id") if isinstance(item, dict) else None for item in items] != [*range(count)]:
        raise _json_error(path / PERIODS, f"objects with ids 0..{count - 1} in order", "others")
    return tuple(_parse_period(path / PERIODS, item) for item in items)


def _parse_period(place: Path, item: dict[str, Any]) -> Period:
    _check_keys(place, item, {"id", "label", "date"})
    label, when = item.get("label", str(item["id"])), item.get("date")
    if not isinstance(label, str) or not label.strip():
        raise _json_error(place, "a label that is a text", repr(label))
    if when is not None and not (isinstance(when, str) and is_iso_date(when)):
        raise _json_error(place, "a date YYYY, YYYY-MM or YYYY-MM-DD, or null", repr(when))
    return Period(item["id"], label, when)


def is_iso_date(text: str) -> bool:
    """Whether a text is a calendar date: year, year-month or year-month-day."""
    if not re.fullmatch(r"[0-9]{4}(-[0-9]{2}){0,2}", text):
        return False
    try:
        date.fromisoformat(text + "-01" * (2 - text.count("-")))
    except ValueError:
        return False
    return True


def read_world(path: Path) -> WorldFrame:
    """Unit and reference system from ``world.json``, or unknown where the file is absent."""
    place = path / WORLD
    if not place.exists():
        return WorldFrame()
    data = _read_json(place, dict)
    _check_keys(place, data, {"unit", "crs", "offset"})
    unit, crs, offset = data.get("unit", "unknown"), data.get("crs"), data.get("offset", [0, 0, 0])
    check_choice(f"{place}: unit", str(unit), ("metre", "unknown"), error=SceneError)
    if crs is not None and not isinstance(crs, str):
        raise _json_error(place, "a crs such as EPSG:32650, or null", repr(crs))
    numbers = isinstance(offset, list) and all(
        type(x) in (int, float) and math.isfinite(x) for x in offset
    )
    if not numbers or len(offset) != 3:
        raise _json_error(place, "an offset of three numbers", repr(offset))
    return WorldFrame(unit, crs, (float(offset[0]), float(offset[1]), float(offset[2])))


def _read_json(place: Path, kind: type) -> Any:
    try:
        data = json.loads(read_text(place))
    except (ValueError, RecursionError) as error:
        raise _json_error(place, "JSON", str(error)) from error
    if not isinstance(data, kind):
        raise _json_error(
            place, "a list" if kind is list else "an object", f"{type(data).__name__}"
        )
    return data


def _check_keys(place: Path, item: dict[str, Any], known: set[str]) -> None:
    if unknown := sorted(item.keys() - known):
        raise _json_error(place, f"only the keys {', '.join(sorted(known))}", ", ".join(unknown))


def _json_error(place: Path, expected: str, found: str) -> SceneError:
    return SceneError(place, expected=expected, found=found, todo="see DATASET.md")


def write(scene: Scene, out: Path, *, image_source: ImageSource = "copy") -> Path:
    """Write a scene in this format; the folder appears complete or not at all.

    Args:
        scene: Any scene, of whatever format.
        out: Folder that does not exist yet, or is empty.
        image_source: ``copy`` the images, make hard ``link``s where the disk can (else copies),
            or write ``none``.

    Raises:
        SceneError: If ``out`` is in use, or an image is missing.
    """
    out = Path(out)
    check_choice("image_source", image_source, ("copy", "link", "none"))
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise SceneError(
            out, expected="a new or empty folder", found="one in use", todo="choose another folder"
        )
    for frame in scene.frames:
        _check_writable_name(out, frame)
    out.parent.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=f".{out.name}-", dir=out.parent) as temporary:
        staged = Path(temporary) / "scene"
        (staged / MODEL).mkdir(parents=True)
        write_model(staged / MODEL, scene.frames, scene.points)
        _write_texts(scene, staged)
        if image_source != "none":
            _write_images(scene, staged / "images", link=image_source == "link")
        if out.exists():
            out.rmdir()
        staged.rename(out)
    return out


def _check_writable_name(place: Path, frame: Frame) -> None:
    """Refuse a name that would leave the folder or that one line of text cannot hold."""
    check_name(place, frame.name)
    entries, _ = parse_split_text(format_split_text({frame.name: frame.period}))
    if [(entry.name, entry.period) for entry in entries] != [(frame.name, frame.period)]:
        raise SceneError(
            place,
            expected="image names without line breaks, and without blanks at their ends",
            found=repr(frame.name),
            todo="rename the image",
        )


def _write_texts(scene: Scene, root: Path) -> None:
    tests = [f.name for f in scene.frames if f.split == "test"]
    periods = [{"id": p.id, "label": p.label, "date": p.date} for p in scene.periods]
    world = scene.world
    files = {
        SPLIT: format_split_text({f.name: f.period for f in scene.frames}),
        TEST: "".join(f"{name}\n" for name in tests),
        PERIODS: json.dumps(periods, indent=1, ensure_ascii=False) + "\n",
        WORLD: json.dumps({"unit": world.unit, "crs": world.crs, "offset": world.offset}) + "\n",
    }
    for name, text in files.items():
        (root / name).write_text(text, encoding="utf-8", newline="\n")


def _write_images(scene: Scene, root: Path, *, link: bool) -> None:
    for frame in scene.frames:
        source, target = scene.image_path(frame), root / frame.name
        target.parent.mkdir(parents=True, exist_ok=True)
        if not source.is_file():
            raise SceneError(source, expected="an image", found="nothing", todo="copy it there")
        if link:
            try:
                os.link(source, target)
                continue
            except OSError:
                pass  # another disk, or one without links
        shutil.copyfile(source, target)
