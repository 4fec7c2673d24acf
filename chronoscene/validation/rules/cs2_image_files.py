"""CS20, CS21: presence, size and kind of the image files; CS24: their masks."""

from __future__ import annotations

import os
from collections.abc import Iterator, Mapping
from pathlib import PurePosixPath

from chronoscene.colmap.raw_model import RawImages
from chronoscene.images.masks import MASKS, MODES, mask_name, mask_place
from chronoscene.io.wording import counted, quote, shown
from chronoscene.scene import Camera
from chronoscene.validation import rule
from chronoscene.validation.folder.names import Spellings
from chronoscene.validation.folder.pixels import Header, Pixels
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit

KINDS = {
    ".jpg": ("JPEG", "MPO"),
    ".jpeg": ("JPEG", "MPO"),
    ".png": ("PNG",),
    ".tif": ("TIFF",),
    ".tiff": ("TIFF",),
    ".bmp": ("BMP", "DIB"),
    ".webp": ("WEBP",),
}
"""Extension to Pillow's names of the formats found in such files. Cameras put MPO into ``.jpg``."""


@rule.error(
    "CS201",
    bad="`images.bin` has `a.jpg`, but there is only `images/a.JPG`",
    remedy=f"copy the image there, or leave it out ({rule.LEAVE_OUT})",
)
def image_missing(scene: RawScene, names: list[str]) -> Iterator[Hit]:
    """The file of a registered image is missing."""
    if not (scene.root / "images").is_dir():
        return  # has its own rule
    present, others = set(scene.present), Spellings(_unregistered(scene))
    for name in names:
        if name not in present:
            near = others.find(name)
            path = scene.image_path(name)
            folder, link = os.path.isdir(path), os.path.islink(path)
            found = "a folder" if folder else "a broken link" if link else "nothing"
            found += f"; there is {quote(near)}" if near else ""
            yield Hit(f"images/{name}", "an image", found)


def _unregistered(scene: RawScene) -> list[str]:
    registered = set(scene.names)
    return [file for file in scene.files if file not in registered]


@rule.info(
    "CS202",
    bad="`images/b.jpg`, which COLMAP could not register",
    remedy="nothing to do, unless the image should have been registered",
)
def image_unregistered(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """A file in `images/` is not registered in the model, so it is not used."""
    if not scene.names:
        return  # has its own rule
    files, present = _unregistered(scene), set(scene.present)
    spellings = Spellings(files)
    # Files that a missing image, or one with an impossible name, probably means are named there.
    named = {spellings.find(name) for name in set(images.names) - present}
    for file in files:
        if file not in named:
            yield Hit(f"images/{file}", "a registered image", "one that is not in the model")


@rule.error(
    "CS203",
    bad="a file of zero bytes; a text file named `a.jpg`",
    remedy="copy the file again, or convert it to JPEG or PNG",
)
def image_unreadable(headers: dict[str, Header]) -> Iterator[Hit]:
    """An image file is empty, or is not an image."""
    for name, header in headers.items():
        if header.problem is not None:
            yield Hit(f"images/{name}", "an image", header.problem)
        elif header.mode == "F":
            yield Hit(f"images/{name}", "8 or 16 bit pixels", "floating point pixels")


@rule.error(
    "CS204",
    bad="a camera of 4000 x 3000 and a file of 3000 x 4000, rotated by its orientation tag",
    remedy="use the images that the model was made from, not cropped, rotated or padded copies",
    needs=("cameras", "images"),
)
def image_shape(scene: RawScene) -> Iterator[Hit]:
    """The aspect ratio of an image differs from that of its camera, so pixels and rays do not
    match."""
    for name, size, camera in _sizes(scene):
        if not _same_shape(size, camera):
            rotated = _same_shape(size[::-1], camera)
            found = f"{size[0]} x {size[1]}" + (", rotated by 90 degrees" if rotated else "")
            tag = scene.headers[name].orientation
            found += f" as its orientation tag {tag} says" if rotated and tag >= 5 else ""
            yield Hit(f"images/{name}", _expected(camera), found)


@rule.warning(
    "CS205",
    bad="a camera of 4000 x 3000 and a file of 1000 x 750",
    remedy="scale the camera to the files, or use files of the camera's size",
    needs=("cameras", "images"),
)
def image_size(scene: RawScene) -> Iterator[Hit]:
    """An image has the aspect ratio of its camera, but another size."""
    for name, size, camera in _sizes(scene):
        if size != (camera.width, camera.height) and _same_shape(size, camera):
            yield Hit(f"images/{name}", _expected(camera), f"{size[0]} x {size[1]}")


def images_of_other_shape(scene: RawScene, headers: Mapping[str, Header] | None = None) -> set[str]:
    """Names of the images whose aspect ratio is not that of their camera.

    Args:
        scene: The scene.
        headers: Of images, by their names in the model; None for those that are present.
    """
    sizes = _sizes(scene, headers)
    return {name for name, size, camera in sizes if not _same_shape(size, camera)}


def _sizes(
    scene: RawScene, headers: Mapping[str, Header] | None = None
) -> Iterator[tuple[str, tuple[int, int], Camera]]:
    """Name, size of the file, and camera of the images that have both."""
    assert scene.images is not None
    headers = scene.headers if headers is None else headers
    cameras = scene.usable_cameras
    for name, camera_id in zip(scene.images.names, scene.images.camera_ids.tolist(), strict=True):
        header = headers.get(name)
        if header is not None and header.problem is None and camera_id in cameras:
            yield name, header.size, cameras[camera_id]


def _same_shape(size: tuple[int, ...], camera: Camera) -> bool:
    """Return True if the aspect ratios are equal up to rounding of one side to whole pixels."""
    width, height = size
    exact_height = width * camera.height / camera.width
    exact_width = height * camera.width / camera.height
    return abs(height - exact_height) <= 1 or abs(width - exact_width) <= 1


def _expected(camera: Camera) -> str:
    return f"{camera.width} x {camera.height} as in camera {camera.camera_id}"


@rule.error(
    "CS206", bad="a JPEG truncated during transfer", remedy="copy the file again from its source"
)
def image_damaged(pixels: dict[str, Pixels], headers: dict[str, Header]) -> Iterator[Hit]:
    """An image file is damaged: its header is valid, but its pixels cannot be decoded (needs
    `--decode`)."""
    for name, decoded in pixels.items():
        if decoded.problem is not None and headers[name].mode != "F":
            yield Hit(f"images/{name}", "an image that can be decoded", decoded.problem)


@rule.info(
    "CS207",
    bad="a phone photo in portrait with EXIF orientation 6",
    remedy="remove the tag, but leave the pixels as they are: the poses refer to them "
    "(chronoscene validate --fix does so for JPEG files)",
)
def orientation_tag(scene: RawScene, readable: dict[str, Header]) -> Iterator[Hit]:
    """An image has an orientation tag. ChronoScene and COLMAP ignore it, but viewers rotate the
    image."""
    rotated = images_of_other_shape(scene) if scene.cameras is not None else set()
    for name, header in readable.items():
        if name not in rotated and header.orientation in range(2, 9):  # else an error names the tag
            yield Hit(f"images/{name}", "no orientation tag", f"orientation {header.orientation}")


@rule.error(
    "CS208",
    bad="a JPEG of which only the first half was uploaded",
    remedy="copy the file again from its source",
)
def image_cut_off(scene: RawScene, readable: dict[str, Header]) -> Iterator[Hit]:
    """An image file is truncated. With `--decode`, CS206 reports such files."""
    pixels = scene.pixels or {}
    for name, header in readable.items():
        if header.truncated and (name not in pixels or pixels[name].problem is None):
            yield Hit(f"images/{name}", f"a complete {header.kind} file", "one without its end")


@rule.info(
    "CS211",
    bad="a PNG with 16 bits per channel",
    remedy="nothing to do here; save it with 8 bits per channel for other readers",
)
def image_deep(readable: dict[str, Header]) -> Iterator[Hit]:
    """An image has more than 8 bits per channel. Only 8 are used; the released code may not be able
    to read it."""
    for name, header in readable.items():
        if header.deep and header.mode != "F":
            yield Hit(f"images/{name}", "8 bits per channel", f"more ({header.kind})")


@rule.warning(
    "CS212", bad="a JPEG in CMYK", remedy="convert the image to RGB using its colour profile"
)
def image_cmyk(readable: dict[str, Header]) -> Iterator[Hit]:
    """An image is in CMYK, the colours of printing: it is converted to RGB without its colour
    profile, so its colours differ from those of the other images."""
    for name, header in readable.items():
        if header.mode == "CMYK":
            yield Hit(f"images/{name}", "pixels in RGB", "pixels in CMYK")


@rule.info(
    "CS213",
    bad="a PNG with an alpha channel",
    remedy="nothing to do if this is intended; otherwise save the image without transparency",
)
def image_transparent(readable: dict[str, Header]) -> Iterator[Hit]:
    """An image may have transparent pixels: those whose alpha is below one half are ignored in
    training and in testing."""
    for name, header in readable.items():
        if header.transparent:
            yield Hit(f"images/{name}", "opaque pixels", f"pixels of mode {header.mode}")


@rule.warning(
    "CS215", bad="a PNG named `a.jpg`", remedy=f"rename the image ({rule.RENAME}), or convert it"
)
def image_misnamed(readable: dict[str, Header]) -> Iterator[Hit]:
    """The extension of an image does not match its file format; programs that go by the extension
    fail."""
    for name, header in readable.items():
        known = KINDS.get(PurePosixPath(name).suffix.lower())
        if known is not None and header.kind not in known:
            yield Hit(f"images/{name}", f"a {known[0]} file", f"a {header.kind} file")


@rule.error(
    "CS241",
    bad="a mask in RGB; a mask of zero bytes",
    remedy="save the mask as a grey PNG: 0 where the image is ignored, anything else elsewhere",
)
def mask_unreadable(scene: RawScene, mask_headers: dict[str, Header]) -> Iterator[Hit]:
    """A mask cannot be read, or is no image of one channel with 8 bits."""
    for name, header in mask_headers.items():
        if header.problem is not None:
            yield Hit(mask_place(name), "an image", header.problem)
        elif header.mode not in MODES:
            yield Hit(mask_place(name), "one channel of 8 bits", f"pixels of mode {header.mode}")
        elif header.truncated:
            yield Hit(mask_place(name), "an image that can be decoded", "a damaged one")


@rule.error(
    "CS242",
    bad="a photo of 4000 x 3000 and its mask of 1000 x 750",
    remedy="make the mask from the image file that is in images/",
)
def mask_size(readable: dict[str, Header], mask_headers: dict[str, Header]) -> Iterator[Hit]:
    """A mask has another size than its image."""
    for name, header in mask_headers.items():
        if header.problem is None and name in readable and header.size != readable[name].size:
            width, height = readable[name].size
            found = f"{header.size[0]} x {header.size[1]}"
            yield Hit(mask_place(name), f"{width} x {height} as images/{name}", found)


@rule.warning(
    "CS243",
    bad="`masks/x.png` for `images/x.jpg`, whose mask is `masks/x.jpg.png`",
    remedy="name the mask after its image, with the extension of the image and then .png; "
    "chronoscene validate --fix does so where only capitals or the form of accents differ",
)
def mask_without_image(scene: RawScene, names: list[str]) -> Iterator[Hit]:
    """A file in `masks/` is not the mask of an image, so it is not used."""
    images = {*names, *scene.files}
    others = Spellings(images - scene.mask_headers.keys())
    for file in scene.mask_files:
        if file.removesuffix(".png") in images and file.endswith(".png"):
            continue
        near = others.find(file) or others.find(file.removesuffix(".png"))
        hint = f"; the mask of {quote(near)} would be {quote(mask_name(near))}" if near else ""
        yield Hit(f"{MASKS}/{file}", "the mask of an image", f"no image of this name{hint}")


@rule.warning(
    "CS245",
    bad="masks of 40 out of 50 photos of a period, for example where the masking stopped",
    remedy="add the masks that are missing, if something is to be ignored in these images",
)
def masks_missing(periods: dict[str, int], mask_headers: dict[str, Header]) -> Iterator[Hit]:
    """Some images of a period have a mask, and others have none, so all of them counts."""
    for period in sorted({periods[name] for name in mask_headers if name in periods}):
        images = [name for name, of in periods.items() if of == period]
        without = [name for name in images if name not in mask_headers]
        if without:
            expected = f"a mask of each of the {len(images)} images of period {period}"
            found = f"none of {counted(len(without), 'image')}: {shown(without)}"
            yield Hit(MASKS, expected, found, count=len(without))
