"""WAT (World Across Time), the data of CLNeRF: ``images/<task>/<frame>`` and ``sparse/0``.

A period is a task; tasks are in the order in which their folders first appear among the sorted
names. The test images are those with the index 0, 8, 16, ... in each task, which is the rule of
its own loader and ours.

Every image keeps the camera that the model gives it, with its distortion. The loader of CLNeRF
uses the first camera for all images and ignores distortion; results that are to be compared with
its own need images undistorted to one camera.

Nothing in these files says that they are WAT, so the names of its ten scenes are the mark. A scene
of another name in the same layout is `colmap-folders`, whose reading is the same where the folders
are in natural order.

Source: Cai and Mueller, CLNeRF, ICCV 2023; layout as in ``IntelLabs/CLNeRF`` at ``d5573a7``.
"""

from __future__ import annotations

from pathlib import Path

from chronoscene.errors import SceneError
from chronoscene.formats.colmap_layout import find_model, layout, make_scene, read_images
from chronoscene.formats.grouping import group_labels
from chronoscene.scene import Scene
from chronoscene.splits import DEFAULT_RULE, default_tests

NAME = "wat"
MARKS = "images/<task>/ and sparse/0/ in a folder named as a scene of WAT"
"""What `matches` looks for."""

SCENES = (
    "breville", "car", "community", "grill", "kitchen", "living_room", "mac", "ninja", "spa",
    "street",
)  # fmt: skip
"""Names of the scenes; some are also there as ``<name>_resized``."""


def matches(path: Path) -> bool:
    """Whether a folder has the name of a scene of WAT, and its layout."""
    name = path.resolve().name.lower().removesuffix("_resized")
    return name in SCENES and find_model(path) is not None and layout(path / "images") == "folders"


def read(path: Path) -> Scene:
    """Read a scene.

    Raises:
        SceneError: If it is damaged, or images are not in folders.
    """
    path = Path(path)
    model = read_images(path, path / "images")
    tasks = {image.name: _task(path, image.name) for image in model.images}
    grouped = group_labels(tasks, list(dict.fromkeys(tasks[name] for name in sorted(tasks))))
    return make_scene(
        path,
        path / "images",
        model,
        grouped,
        default_tests(grouped[0]),
        rule=DEFAULT_RULE,
        format=NAME,
    )


def _task(path: Path, name: str) -> str:
    folder, slash, _ = name.rpartition("/")
    if not slash:
        raise SceneError(
            path / "images",
            expected="every image in the folder of its task",
            found=repr(name),
            todo="give the folder of one scene of WAT, or name its --format",
        )
    return folder
