"""Plain COLMAP with one folder of images per period: ``images/<period>/...`` and ``sparse/0``.

The first folder of an image name is its period; periods are in the natural order of the folders
(``t2`` before ``t10``), which are also their labels. ``sparse/0/test.txt`` lists the test images
where it exists, as in the ChronoScene format.
"""

from __future__ import annotations

import re
from pathlib import Path

from chronoscene.colmap import write_model
from chronoscene.errors import SceneError
from chronoscene.formats import wat
from chronoscene.formats.chronoscene import (
    MODEL,
    TEST,
    check_writable_name,
    raise_first,
)
from chronoscene.formats.colmap_layout import find_model, layout, make_scene, read_images, scan
from chronoscene.formats.grouping import (
    TABLE,
    group_by_table,
    group_labels,
    natural_key,
    rule_error,
)
from chronoscene.formats.writing import (
    ImageSource,
    Progress,
    place_image,
    renamed,
    staged_folder,
)
from chronoscene.scene import Period, Scene
from chronoscene.splits import (
    DEFAULT_RULE,
    assign_tests,
    default_tests,
    parse_test_text,
    read_text,
)

NAME = "colmap-folders"
MARKS = "images/<period>/ and sparse/0/"
"""What `matches` looks for."""

PERIOD_BY = ("folder", "table:FILE")
"""The first folder of the names (default), or a CSV file with the columns file and period."""


def matches(path: Path) -> bool:
    """Whether a folder has images in folders and a model, and is not clearly of WAT."""
    if find_model(path) is None or layout(path / "images") != "folders":
        return False
    return not (wat.matches(path) and _is_same_to_wat(path))


def _is_same_to_wat(path: Path) -> bool:
    """Whether both formats put the folders in the same order; else the reader must be named."""
    folders, _ = scan(path / "images")
    return sorted(folders) == sorted(folders, key=natural_key)


def read(path: Path, *, period_by: str = "folder") -> Scene:
    """Read a scene.

    Raises:
        SceneError: If it is damaged, or images are not in folders.
        ConfigError: If ``period_by`` is not in `PERIOD_BY`.
    """
    path = Path(path)
    model = read_images(path, path / "images")
    names = [image.name for image in model.images]
    if period_by.startswith(TABLE):
        grouped = group_by_table(names, Path(period_by.removeprefix(TABLE)))
    elif period_by == "folder":
        labels = {name: _folder(path, name) for name in names}
        grouped = group_labels(labels, sorted(set(labels.values()), key=natural_key))
    else:
        raise rule_error(period_by, PERIOD_BY)
    tests, rule = default_tests(grouped[0]), DEFAULT_RULE
    if (path / TEST).exists():
        tests, problems = assign_tests(names, parse_test_text(read_text(path / TEST)))
        raise_first(path / TEST, problems)
        rule = TEST
    return make_scene(path, path / "images", model, grouped, tests, rule=rule, format=NAME)


def _folder(path: Path, name: str) -> str:
    folder, slash, _ = name.partition("/")
    if not slash:
        raise SceneError(
            path / "images",
            expected="every image in a folder of its period",
            found=repr(name),
            todo="name the periods with --period-by table:FILE (columns file and period), or "
            "write sparse/split.txt as DATASET.md says",
        )
    return folder


def write(
    scene: Scene,
    out: Path,
    *,
    image_source: ImageSource = "copy",
    progress: Progress | None = None,
) -> Path:
    """Write a scene in this format; the folder appears complete or not at all.

    Images go to the folder of their period. It is named after the period's label where labels are
    names of folders in the order of the periods, else after its id and label.

    Raises:
        SceneError: If ``out`` is in use, or an image is missing.
    """
    out = Path(out)
    names = names_in_folders(scene)
    new = renamed(scene, names)
    for frame in new.frames:
        check_writable_name(out, frame)
    with staged_folder(out) as staged:
        (staged / MODEL).mkdir(parents=True)
        write_model(staged / MODEL, new.frames, new.points)
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


def period_folders(periods: tuple[Period, ...]) -> list[str]:
    """A folder for each period, whose natural order is the order of the periods."""
    labels = [period.label for period in periods]
    plain = all(re.fullmatch(r"\w[\w.+ -]*(?<! )", label) for label in labels)
    if plain and labels == sorted(set(labels), key=natural_key):
        return labels
    return [f"{p.id}_" + re.sub(r"[^\w.+-]+", "-", p.label) for p in periods]


def names_in_folders(scene: Scene) -> dict[str, str]:
    """New name of each image. Names that are all in the folders of their periods stay."""
    folders = period_folders(scene.periods)
    old = {f.name: folders[f.period] for f in scene.frames}
    if all(name.startswith(f"{folder}/") for name, folder in old.items()):
        return {name: name for name in old}
    return {name: f"{folder}/{name}" for name, folder in old.items()}
