"""WAT (World Across Time), the data of CLNeRF: ``images/<task>/<frame>`` and ``sparse/0``.

A period is a task; tasks are in the order in which their folders first appear among the sorted
names. The test images are those with the index 0, 8, 16, ... in each task, which is the rule of
its own loader and ours.

Every image keeps the camera that the model gives it, with its distortion. The loader of CLNeRF
uses the first camera for all images and ignores distortion; results that are to be compared with
its own need images undistorted to one camera.

Nothing in these files marks them as WAT, so the names of its ten scenes are the mark. A scene
of another name in the same layout is `colmap-folders`, which reads the same where the folders are
in natural order. Any project may be called ``street``: one with a list of test images, which WAT
lacks, or with folders in its folders is `colmap-folders`, too.

Source: Cai and Mueller, CLNeRF, ICCV 2023; layout as in ``IntelLabs/CLNeRF`` at ``d5573a7``.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from chronoscene.colmap.raw_model import FoundModel
from chronoscene.errors import SceneError
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats.shared import colmap_layout
from chronoscene.formats.shared.grouping import group_labels
from chronoscene.images.store import ImageSource, Progress
from chronoscene.scene import Camera, Scene
from chronoscene.scene.cameras import as_pinhole, way_to_pinhole
from chronoscene.scene.splits import DEFAULT_RULE, default_tests

NAME = "wat"
MARKS = "images/<task>/ and sparse/0/ in a folder named as a scene of WAT"
"""Description of the marks that `matches` looks for."""

READ_MODELS = ("SIMPLE_RADIAL", "PINHOLE", "OPENCV")
"""Camera models that the loader of CLNeRF reads; it ignores distortion."""

SCENES = (
    "breville", "car", "community", "grill", "kitchen", "living_room", "mac", "ninja", "spa",
    "street",
)  # fmt: skip
"""Names of the scenes; some are also there as ``<name>_resized``."""


def matches(path: Path, model: FoundModel | None) -> bool:
    """Return True if a folder has the name of a scene of WAT, and its layout."""
    if model is None or path.resolve().name.lower().removesuffix("_resized") not in SCENES:
        return False
    images = path / model[1]
    if not colmap_layout.is_in_folders(images) or (path / our_format.TEST).exists():
        return False
    folders, _ = colmap_layout.scan(images)
    return not any(colmap_layout.scan(images / folder)[0] for folder in folders)


def read(path: Path, *, model: FoundModel | None = None) -> Scene:
    """Read a scene."""
    return colmap_layout.read_scene(path, model, assign, NAME)


def assign(images: Path, names: list[str]) -> colmap_layout.Assigned:
    """Assign periods and test images by the names of the images."""
    tasks = {name: _task(images, name) for name in names}
    grouped = group_labels(tasks, list(dict.fromkeys(tasks[name] for name in sorted(tasks))))
    return colmap_layout.Assigned(grouped, default_tests(grouped[0]), DEFAULT_RULE)


def _task(images: Path, name: str) -> str:
    folder, slash, _ = name.rpartition("/")
    if not slash:
        raise SceneError(
            images,
            expected="every image in the folder of its task",
            found=repr(name),
            todo="if this is no scene of WAT, name its --dataset-format, such as colmap-folders",
        )
    return folder


def write(
    scene: Scene, out: Path, *, image_source: ImageSource = "copy", progress: Progress | None = None
) -> Path:
    """Write a scene for the loader of CLNeRF.

    Each period becomes a task: a folder directly in ``images/``, named after the label where the
    alphabetical order of the labels is that of the periods, else after id and label. The loader
    uses the size and intrinsics of camera 1 for all images, so there must be only one camera.
    """
    camera = _one_camera(scene, out)
    return colmap_layout.write_renamed(
        scene.with_frames([replace(frame, camera=camera) for frame in scene.frames]),
        out,
        _names(scene),
        texts=(our_format.PERIODS, our_format.WORLD),
        image_source=image_source,
        progress=progress,
    )


def _one_camera(scene: Scene, out: Path) -> Camera:
    """Return the camera of all images, as number 1 and in a model that the loader reads."""
    cameras = {replace(frame.camera, camera_id=1) for frame in scene.frames}
    camera = cameras.pop()
    if camera.is_pinhole and camera.model not in READ_MODELS:
        camera = as_pinhole(camera)
    if cameras or camera.model not in READ_MODELS:
        raise SceneError(
            out,
            expected=f"one camera for all images, and of {', '.join(READ_MODELS)}, as the loader "
            "of CLNeRF takes camera 1 for all",
            found=f"{len(cameras) + 1} cameras" if cameras else camera.model,
            todo="choose another format with --to"
            if cameras
            else f"{way_to_pinhole(camera)} first",
        )
    return camera


def losses(scene: Scene) -> list[str]:
    """List the content of a scene that this format, or the loader that it is for, cannot hold."""
    names = _names(scene)
    tests = default_tests({names[f.name]: f.period for f in scene.frames})
    lost = colmap_layout.lost_names(names)
    lost += colmap_layout.lost_split(scene, names, tests, "images 0, 8, 16, ... of each task")
    lost += colmap_layout.lost_masks(scene)
    if any(not frame.camera.is_pinhole for frame in scene.frames):
        lost.append("distortion, which its loader ignores: undistort first")
    files = [name.rpartition("/")[2] for name in names.values()]
    if len(set(files)) < len(files):
        lost.append("equal file names in several tasks, of which its replay keeps one")
    return lost


def _names(scene: Scene) -> dict[str, str]:
    # The loader sorts full paths, so the slash takes part.
    folders = colmap_layout.period_folders(scene.periods, order=lambda folder: f"{folder}/")
    return colmap_layout.new_names(scene, folders, deep=False)
