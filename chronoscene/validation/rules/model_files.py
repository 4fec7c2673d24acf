"""CS10: the files of the COLMAP model, and the ids in it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator

import numpy as np

from chronoscene.colmap.raw_model import MODEL_FILES
from chronoscene.formats.chronoscene import MODEL
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

MOST_IDS = 2**31 - 1
"""COLMAP's databases count up to here."""


@rule(
    "CS101",
    "model-absent",
    "error",
    what="There is no COLMAP model.",
    remedy="write the model to sparse/0/ (cameras, images, points3D; all .bin or all .txt); photos "
    "without poses need registering: chronoscene register",
    bad="an empty folder `sparse/0/`",
)
def model_absent(scene: RawScene) -> Iterator[Hit]:
    if scene.model_place is None:
        yield Hit(MODEL, "a COLMAP model", "none")


@rule(
    "CS102",
    "model-partial",
    "error",
    what="Some of the three files of the model are missing, or their forms are mixed.",
    remedy="copy the missing files, or write the model again; all .bin or all .txt",
    bad="`cameras.bin` and `images.bin` without `points3D.bin`",
    needs=("model",),
)
def model_partial(scene: RawScene) -> Iterator[Hit]:
    assert scene.model is not None
    files = scene.model.files
    for stem in MODEL_FILES:
        if stem not in files:
            yield Hit(scene.model_file(stem), f"{stem}.bin or {stem}.txt", "neither")
    if len(files) == len(MODEL_FILES) and len({file[-4:] for file in files.values()}) > 1:
        found = ", ".join(files.values())
        yield Hit(scene.model_place or ".", "files of one form, .bin or .txt", found)


@rule(
    "CS103",
    "model-damaged",
    "error",
    what="A file of the model cannot be read to its end.",
    remedy="copy the file again or write the model again with COLMAP",
    bad="`images.bin` cut off by a full disk",
    needs=("model",),
)
def model_damaged(scene: RawScene) -> Iterator[Hit]:
    assert scene.model is not None
    folder = f"{scene.model_place}/" if scene.model_place else ""
    for damage in scene.model.damages:
        yield Hit(f"{folder}{damage.file}", damage.expected, damage.found)


@rule(
    "CS104",
    "two-forms",
    "info",
    what="The model is there in binary and in text; the text is not read.",
    remedy="delete the form that is not meant, so that they cannot differ",
    bad="`images.bin` beside `images.txt`",
    needs=("model",),
)
def two_forms(scene: RawScene) -> Iterator[Hit]:
    assert scene.model is not None
    for stem, file in scene.model.files.items():
        if file.endswith(".bin") and (scene.model.folder / f"{stem}.txt").is_file():
            yield Hit(scene.model_file(stem), "one form of the file", f"{stem}.txt too")


@rule(
    "CS105",
    "no-images",
    "error",
    what="The model has no registered image.",
    remedy="register the images with COLMAP",
    bad="an `images.txt` of comments only",
    needs=("images",),
)
def no_images(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    if not len(scene.images):
        yield Hit(scene.model_file("images"), "registered images", "none")


@rule(
    "CS106",
    "duplicate-id",
    "error",
    what="Two cameras or two images have the same id.",
    remedy="give each its own id, and correct what refers to it",
    bad="two lines of `images.txt` that begin with `7`",
    needs=("model",),
)
def duplicate_id(scene: RawScene) -> Iterator[Hit]:
    cameras = [c.camera_id for c in scene.cameras or ()]
    images = scene.images.ids.tolist() if scene.images else []
    for stem, ids in (("cameras", cameras), ("images", images)):
        for repeated, times in Counter(ids).items():
            if times > 1:
                yield Hit(scene.model_file(stem), "each id once", f"id {repeated} {times} times")


@rule(
    "CS108",
    "unknown-camera",
    "error",
    what="An image refers to a camera that the model does not have.",
    remedy="write cameras and images again together",
    bad="image `a.jpg` with camera 3, `cameras.bin` has camera 1 only",
    needs=("cameras", "images"),
)
def unknown_camera(scene: RawScene) -> Iterator[Hit]:
    assert scene.cameras is not None and scene.images is not None
    known = np.array([c.camera_id for c in scene.cameras], np.int64)
    for i in np.flatnonzero(~np.isin(scene.images.camera_ids, known)):
        place = scene.image_place(scene.images.names[i])
        found = f"camera {scene.images.camera_ids[i]}"
        yield Hit(place, "a camera of the model", found)


@rule(
    "CS109",
    "id-out-of-range",
    "error",
    what="The id of a camera or image is one that COLMAP cannot have.",
    remedy="give it an id from 1 on, and correct what refers to it",
    bad="image id -1; camera id 4294967295",
    needs=("model",),
)
def id_out_of_range(scene: RawScene) -> Iterator[Hit]:
    cameras = [camera.camera_id for camera in scene.cameras or ()]
    images = scene.images.ids.tolist() if scene.images else []
    for stem, ids in (("cameras", cameras), ("images", images)):
        for wrong in sorted({i for i in ids if not 0 <= i < MOST_IDS}):
            yield Hit(scene.model_file(stem), f"ids from 0 to {MOST_IDS - 1}", f"id {wrong}")
