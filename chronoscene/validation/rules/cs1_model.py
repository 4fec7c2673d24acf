"""CS10, CS11: the files of the COLMAP model, and the ids and image names in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from chronoscene.colmap.raw_model import MODEL_FILES, RawImages, RawModel, find_stray_model
from chronoscene.formats.chronoscene import MODEL
from chronoscene.io.wording import quote
from chronoscene.scene import Camera
from chronoscene.validation import rule
from chronoscene.validation.folder.names import is_safe
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit


@rule.error(
    "CS101",
    bad="an empty folder `sparse/0/`",
    remedy="write the model to sparse/0/ (cameras, images, points3D; all .bin or all .txt); to "
    "register photos without poses, use chronoscene register",
)
def model_absent(scene: RawScene) -> Iterator[Hit]:
    """There is no COLMAP model."""
    if scene.model_place is None:
        stray = find_stray_model(scene.root)
        remedy = f"copy the model in {stray} to {MODEL}" if stray else None
        yield Hit(MODEL, "a COLMAP model", f"one in {stray}" if stray else "none", remedy)


@rule.error(
    "CS102",
    bad="`cameras.bin` and `images.bin` without `points3D.bin`",
    remedy="copy the missing files, or write the model again, with all files .bin or all .txt",
)
def model_partial(scene: RawScene, model: RawModel) -> Iterator[Hit]:
    """Some of the three model files are missing, or binary and text files are mixed."""
    for stem in MODEL_FILES:
        if stem not in model.files:
            yield Hit(scene.model_file(stem), f"{stem}.bin or {stem}.txt", "neither")
    if len(model.files) == len(MODEL_FILES) and len({f[-4:] for f in model.files.values()}) > 1:
        found = ", ".join(model.files.values())
        yield Hit(scene.model_place or ".", "only .bin or only .txt files", found)


@rule.error(
    "CS103",
    bad="`images.bin` truncated by a full disk",
    remedy="copy the file again, or write the model again with COLMAP",
)
def model_damaged(scene: RawScene, model: RawModel) -> Iterator[Hit]:
    """A model file is damaged and cannot be read completely."""
    folder = f"{scene.model_place}/" if scene.model_place else ""
    for damage in model.damages:
        yield Hit(f"{folder}{damage.file}", damage.expected, damage.found)


@rule.info(
    "CS104",
    bad="`images.bin` next to `images.txt`",
    remedy="delete the form that is not needed, so that the two cannot diverge",
)
def two_forms(scene: RawScene, model: RawModel) -> Iterator[Hit]:
    """The model exists in binary and in text form; the text files are not read."""
    for stem, file in model.files.items():
        if file.endswith(".bin") and (model.folder / f"{stem}.txt").is_file():
            yield Hit(scene.model_file(stem), "one form of the file", f"also {stem}.txt")


@rule.error(
    "CS105",
    bad="an `images.txt` with nothing but comments",
    remedy="register the images with COLMAP or chronoscene register",
)
def no_images(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """The model has no registered images."""
    if not len(images):
        yield Hit(scene.model_file("images"), "registered images", "none")


@rule.error(
    "CS106",
    bad="two lines in `images.txt` that start with `7`",
    remedy="give each its own id, and update the references to it",
    needs=("model",),
)
def duplicate_id(scene: RawScene) -> Iterator[Hit]:
    """Two cameras or two images have the same id."""
    for stem, ids in _ids(scene):
        for repeated, times in Counter(ids).items():
            if times > 1:
                yield Hit(scene.model_file(stem), "unique ids", f"id {repeated} {times} times")


@rule.error(
    "CS107",
    bad="`a.jpg` with image id 1 and with image id 2",
    remedy="keep one of them; if they are two photos, rename one file and register it again",
)
def duplicate_name(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """Two images of the model have the same name."""
    for name, times in Counter(images.names).items():
        if times > 1:
            yield Hit(scene.model_file("images"), "unique names", f"{quote(name)} {times} times")


@rule.error(
    "CS108",
    bad="image `a.jpg` with camera 3 when `cameras.bin` has only camera 1",
    remedy="write cameras and images again together",
)
def unknown_camera(scene: RawScene, cameras: Sequence[Camera], images: RawImages) -> Iterator[Hit]:
    """An image refers to a camera that is not in the model."""
    known = np.array([c.camera_id for c in cameras], np.int64)
    for i in np.flatnonzero(~np.isin(images.camera_ids, known)):
        place = scene.image_place(images.names[i])
        yield Hit(place, "a camera of the model", f"camera {images.camera_ids[i]}")


def _ids(scene: RawScene) -> Iterator[tuple[str, list[int]]]:
    yield "cameras", [camera.camera_id for camera in scene.cameras or ()]
    yield "images", scene.images.ids.tolist() if scene.images else []


@rule.error(
    "CS111",
    bad="`../other/a.jpg`, `/home/me/a.jpg`",
    remedy="in the model, change the name to the path relative to images/",
)
def name_leaves_folder(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """An image name is empty or leads out of `images/`."""
    for name in images.names:
        if not is_safe(name):
            yield Hit(scene.model_file("images"), "image names below images/", quote(name))


@rule.error(
    "CS112",
    bad="a name in Latin-1; a name with a line break",
    remedy="rename the file, and the image in the model, using letters and digits",
)
def name_not_text(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """An image name is not UTF-8, or contains control characters."""
    for name in images.names:
        if any(ord(c) < 32 or ord(c) == 127 or 0xD800 <= ord(c) < 0xE000 for c in name):
            place = scene.model_file("images")
            yield Hit(place, "UTF-8 names without control characters", quote(name))
