"""Plain COLMAP with one folder of images per period: ``images/<period>/...`` and ``sparse/0``.

The first folder of an image name is its period; periods are in the natural order of the folders
(``t2`` before ``t10``), which are also their labels. ``sparse/0/test.txt`` lists the test images
where it exists, as in the ChronoScene format.
"""

from __future__ import annotations

from pathlib import Path

from chronoscene.errors import SceneError
from chronoscene.formats import wat
from chronoscene.formats.chronoscene import TEST, raise_first
from chronoscene.formats.shared.colmap_layout import (
    find_model,
    layout,
    lost_labels,
    lost_names,
    make_scene,
    new_names,
    period_folders,
    read_images,
    scan,
    write_renamed,
)
from chronoscene.formats.shared.grouping import (
    TABLE,
    group_by_table,
    group_labels,
    natural_key,
    rule_error,
)
from chronoscene.images.store import ImageSource, Progress
from chronoscene.scene import Scene
from chronoscene.scene.splits import (
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
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a scene in this format; the folder appears complete or not at all.

    Images go to the folder of their period. It is named after the period's label where labels are
    names of folders in the order of the periods, else after its id and label.

    Raises:
        SceneError: If ``out`` is in use, or an image is missing.
    """
    return write_renamed(
        scene,
        Path(out),
        _names(scene),
        test_list=True,
        image_source=image_source,
        progress=progress,
    )


def losses(scene: Scene) -> list[str]:
    """What a scene has that this format cannot hold."""
    return lost_labels(scene, period_folders(scene.periods)) + lost_names(_names(scene))


def _names(scene: Scene) -> dict[str, str]:
    return new_names(scene, period_folders(scene.periods), deep=True)
