"""CS2: image files."""

from __future__ import annotations

import os
from collections.abc import Iterator

from chronoscene.io.wording import quote
from chronoscene.scene import Camera
from chronoscene.validation.checks.spelling import Spellings
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

GREY_MODES = ("1", "L", "LA", "La", "I", "I;16", "I;16B", "I;16L", "I;16N")
"""Pillow's modes without colour."""


@rule(
    "CS201",
    "image-missing",
    "error",
    what="A registered image has no file.",
    remedy="copy the image there, or remove it from the model",
    bad="`images.bin` names `a.jpg`, there is only `images/a.JPG`",
    needs=("images",),
)
def image_missing(scene: RawScene) -> Iterator[Hit]:
    if not (scene.root / "images").is_dir():
        return  # one finding says it for all
    present, others = set(scene.present), Spellings(_unregistered(scene))
    for name in scene.names:
        if name not in present:
            near = others.find(name)
            found = _instead(scene, name) + (f"; there is {quote(near)}" if near else "")
            yield Hit(_place(name), "an image", found)


def _instead(scene: RawScene, name: str) -> str:
    """What is where an image file should be."""
    path = scene.image_path(name)
    if os.path.isdir(path):
        return "a folder"
    return "a link to nothing" if os.path.islink(path) else "nothing"


def _unregistered(scene: RawScene) -> list[str]:
    registered = set(scene.names)
    return [file for file in scene.files if file not in registered]


@rule(
    "CS202",
    "image-unregistered",
    "info",
    what="A file in `images/` is not in the model, so it is not used.",
    remedy="nothing to do, unless the image should have been registered",
    bad="`images/b.jpg` that COLMAP could not place",
    needs=("images",),
)
def image_unregistered(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    if not scene.names:
        return  # an error of its own
    files, present = _unregistered(scene), set(scene.present)
    spellings = Spellings(files)
    # What a missing image or one with an impossible name probably is has been named there.
    named = {spellings.find(name) for name in set(scene.images.names) - present}
    for file in files:
        if file not in named:
            yield Hit(_place(file), "a registered image", "one that the model does not have")


@rule(
    "CS203",
    "image-unreadable",
    "error",
    what="An image file is empty, or does not begin like an image.",
    remedy="copy the file again, or convert it to JPEG or PNG",
    bad="a file of zero bytes; a text file named `a.jpg`",
    needs=("images",),
)
def image_unreadable(scene: RawScene) -> Iterator[Hit]:
    for name, header in scene.headers.items():
        if header.problem is not None:
            yield Hit(_place(name), "an image", header.problem)
        elif header.mode == "F":
            yield Hit(_place(name), "8 or 16 bit pixels", "floating point pixels")


@rule(
    "CS204",
    "image-shape",
    "error",
    what="An image has another shape than its camera, so pixels and rays do not match.",
    remedy="use the images that the model was made from, not cropped, turned or padded ones",
    bad="a camera of 4000 x 3000 and a file of 3000 x 4000, turned by its orientation tag",
    needs=("cameras", "images"),
)
def image_shape(scene: RawScene) -> Iterator[Hit]:
    for name, size, camera in _sizes(scene):
        if not _same_shape(size, camera):
            turned = _same_shape(size[::-1], camera)
            found = f"{size[0]} x {size[1]}" + (", turned by 90 degrees" if turned else "")
            tag = scene.headers[name].orientation
            found += f", as its orientation tag {tag} says" if turned and tag >= 5 else ""
            yield Hit(_place(name), _expected(camera), found)


@rule(
    "CS205",
    "image-size",
    "warning",
    what="An image has the shape of its camera, but another size.",
    remedy="scale the camera to the files, or use files of the camera's size",
    bad="a camera of 4000 x 3000 and a file of 1000 x 750",
    needs=("cameras", "images"),
)
def image_size(scene: RawScene) -> Iterator[Hit]:
    for name, size, camera in _sizes(scene):
        if size != (camera.width, camera.height) and _same_shape(size, camera):
            yield Hit(_place(name), _expected(camera), f"{size[0]} x {size[1]}")


@rule(
    "CS206",
    "image-damaged",
    "error",
    what="An image begins well, but its pixels cannot be decoded (needs `--decode`).",
    remedy="copy the file again from its source",
    bad="a JPEG that a broken transfer cut off",
    needs=("images", "pixels"),
)
def image_damaged(scene: RawScene) -> Iterator[Hit]:
    assert scene.pixels is not None
    for name, pixels in scene.pixels.items():
        if pixels.problem is not None and scene.headers[name].mode != "F":
            yield Hit(_place(name), "an image that can be decoded", pixels.problem)


@rule(
    "CS207",
    "orientation-tag",
    "info",
    what="An image has an orientation tag. It is ignored here and in COLMAP, but viewers turn the "
    "image.",
    remedy="remove the tag (the pixels must stay as they are: the poses refer to them)",
    bad="a phone photo in portrait with EXIF orientation 6",
    needs=("images",),
)
def orientation_tag(scene: RawScene) -> Iterator[Hit]:
    turned = images_of_other_shape(scene) if scene.cameras is not None else set()
    for name, header in scene.headers.items():
        if name in turned:
            continue  # has an error that names the tag
        if header.problem is None and header.orientation in range(2, 9):
            yield Hit(_place(name), "no orientation tag", f"orientation {header.orientation}")


def images_of_other_shape(scene: RawScene) -> set[str]:
    """Names of the images whose shape is not that of their camera."""
    return {name for name, size, camera in _sizes(scene) if not _same_shape(size, camera)}


def _sizes(scene: RawScene) -> Iterator[tuple[str, tuple[int, int], Camera]]:
    """Name, size of the file, and camera of the images that have both."""
    assert scene.images is not None
    cameras = scene.usable_cameras
    for name, camera_id in zip(scene.images.names, scene.images.camera_ids.tolist(), strict=True):
        header = scene.headers.get(name)
        if header is not None and header.problem is None and camera_id in cameras:
            yield name, header.size, cameras[camera_id]


def _same_shape(size: tuple[int, ...], camera: Camera) -> bool:
    """Whether the sizes have one ratio, but for the rounding of one side to whole pixels."""
    width, height = size
    exact_height = width * camera.height / camera.width
    exact_width = height * camera.width / camera.height
    return abs(height - exact_height) <= 1 or abs(width - exact_width) <= 1


def _expected(camera: Camera) -> str:
    return f"{camera.width} x {camera.height} as in camera {camera.camera_id}"


def _place(name: str) -> str:
    return f"images/{name}"
