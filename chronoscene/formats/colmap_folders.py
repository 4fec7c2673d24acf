"""Plain COLMAP with one folder of images per period: ``images/<period>/...`` and ``sparse/0``.

The first folder of an image name is its period; periods are in the natural order of the folders
(``t2`` before ``t10``), which are also their labels. ``sparse/0/test.txt`` lists the test images
where it exists, as in the ChronoScene format.
"""

from __future__ import annotations

from pathlib import Path

from chronoscene.errors import SceneError
from chronoscene.formats import wat
from chronoscene.formats.chronoscene import read_tests
from chronoscene.formats.shared import colmap_layout, grouping
from chronoscene.images.store import ImageSource, Progress
from chronoscene.scene import Scene

NAME = "colmap-folders"
MARKS = "images/<period>/ and sparse/0/"  # What `matches` looks for

PERIOD_BY = ("folder", "table:FILE")
"""The first folder of the names (default), or a CSV file with the columns file and period."""


def matches(path: Path) -> bool:
    """Whether a folder has images in folders and a model, and is not clearly of WAT."""
    images = path / "images"
    if colmap_layout.find_model(path) is None or not colmap_layout.is_in_folders(images):
        return False
    folders, _ = colmap_layout.scan(images)
    # Where both formats put the folders in the same order, WAT wins; else one must be named.
    return not (wat.matches(path) and folders == sorted(folders, key=grouping.natural_key))


def read(path: Path, *, period_by: str = "folder") -> Scene:
    """Read a scene.

    Raises:
        SceneError: If it is damaged, or images are not in folders.
        ConfigError: If ``period_by`` is not in `PERIOD_BY`.
    """
    path = Path(path)
    model = colmap_layout.read_images(path, path / "images")
    names = [image.name for image in model.images]
    if period_by.startswith(grouping.TABLE):
        grouped = grouping.group_by_table(names, Path(period_by.removeprefix(grouping.TABLE)))
    elif period_by == "folder":
        labels = {name: _folder(path, name) for name in names}
        order = sorted(set(labels.values()), key=grouping.natural_key)
        grouped = grouping.group_labels(labels, order)
    else:
        raise grouping.rule_error(period_by, PERIOD_BY)
    tests, rule = read_tests(path, names, grouped[0])
    return colmap_layout.make_scene(
        path, path / "images", model, grouped, tests, rule=rule, format=NAME
    )


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
    return colmap_layout.write_renamed(
        scene,
        Path(out),
        _names(scene),
        test_list=True,
        image_source=image_source,
        progress=progress,
    )


def losses(scene: Scene) -> list[str]:
    """What a scene has that this format cannot hold."""
    labels = colmap_layout.period_folders(scene.periods)
    return colmap_layout.lost_labels(scene, labels) + colmap_layout.lost_names(_names(scene))


def _names(scene: Scene) -> dict[str, str]:
    return colmap_layout.new_names(scene, colmap_layout.period_folders(scene.periods), deep=True)
