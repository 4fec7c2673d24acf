"""CS208 to CS21: what kind of file an image is, as far as its header and its last bytes say."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePosixPath

import numpy as np

from chronoscene.validation.checks.pixels import Header
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

KINDS = {
    ".jpg": ("JPEG", "MPO"),
    ".jpeg": ("JPEG", "MPO"),
    ".png": ("PNG",),
    ".tif": ("TIFF",),
    ".tiff": ("TIFF",),
    ".bmp": ("BMP", "DIB"),
    ".webp": ("WEBP",),
}
"""Extension to Pillow's names of what is in such a file. Cameras put MPO into ``.jpg``."""

BLANK = 2.0
"""Grey levels between the means of the darkest and the brightest part of an image."""


@rule(
    "CS208",
    "image-cut-off",
    "error",
    what="An image file ends before its end. `--decode` reports such a file as CS206.",
    remedy="copy the file again from its source",
    bad="a JPEG of which only the first half was uploaded",
    needs=("images",),
)
def image_cut_off(scene: RawScene) -> Iterator[Hit]:
    pixels = scene.pixels or {}
    for name, header in _headers(scene):
        if header.cut_off and (name not in pixels or pixels[name].problem is None):
            yield Hit(f"images/{name}", f"a whole {header.kind} file", "one without its end")


@rule(
    "CS211",
    "image-deep",
    "info",
    what="An image has more than 8 bits per channel. It is used with 8; the released code may not "
    "read it at all.",
    remedy="nothing to do here; save it with 8 bits per channel for other readers",
    bad="a PNG with 16 bits per channel",
    needs=("images",),
)
def image_deep(scene: RawScene) -> Iterator[Hit]:
    for name, header in _headers(scene):
        if header.deep and header.mode != "F":
            yield Hit(f"images/{name}", "8 bits per channel", f"more ({header.kind})")


@rule(
    "CS212",
    "image-cmyk",
    "warning",
    what="An image is made for printing: its four inks are converted to RGB without its colour "
    "profile, so its colours differ from those of the other images.",
    remedy="convert the image to RGB with its profile",
    bad="a JPEG in CMYK",
    needs=("images",),
)
def image_cmyk(scene: RawScene) -> Iterator[Hit]:
    for name, header in _headers(scene):
        if header.mode == "CMYK":
            yield Hit(f"images/{name}", "pixels in RGB", "pixels in CMYK")


@rule(
    "CS213",
    "image-transparent",
    "info",
    what="An image may have transparent pixels; they get the background colour, in training and in "
    "testing.",
    remedy="nothing to do, if that is meant; else save the image without transparency",
    bad="a PNG with an alpha channel",
    needs=("images",),
)
def image_transparent(scene: RawScene) -> Iterator[Hit]:
    for name, header in _headers(scene):
        if header.transparent:
            yield Hit(f"images/{name}", "opaque pixels", f"pixels of kind {header.mode}")


@rule(
    "CS214",
    "image-animated",
    "warning",
    what="An image has several frames, of which only the first is used.",
    remedy="save the frame that is meant as a file of its own",
    bad="an animated WebP",
    needs=("images",),
)
def image_animated(scene: RawScene) -> Iterator[Hit]:
    for name, header in _headers(scene):
        if header.moving:
            yield Hit(f"images/{name}", "one frame", f"several ({header.kind})")


@rule(
    "CS215",
    "image-misnamed",
    "warning",
    what="The extension of an image is of another file format; some programs go by it and fail.",
    remedy="rename the file, in images/ and in the model, or convert it",
    bad="a PNG named `a.jpg`",
    needs=("images",),
)
def image_misnamed(scene: RawScene) -> Iterator[Hit]:
    for name, header in _headers(scene):
        suffix = PurePosixPath(name).suffix
        known = KINDS.get(suffix.lower())
        if known is not None and header.kind not in known:
            yield Hit(f"images/{name}", f"a {known[0]} file", f"a {header.kind} file")


@rule(
    "CS216",
    "image-blank",
    "warning",
    what="An image is of one colour all over (needs `--decode`).",
    remedy="remove the image from the model: it shows nothing, and trains or tests on nothing",
    bad="a black frame from a video; a photo with the lens cap on",
    needs=("pixels",),
)
def image_blank(scene: RawScene) -> Iterator[Hit]:
    for name, pixels in (scene.pixels or {}).items():
        thumbnail = pixels.thumbnail
        if thumbnail is not None and np.ptp(thumbnail, axis=(0, 1)).max() <= BLANK:
            red, green, blue = (round(float(c)) for c in thumbnail.mean(axis=(0, 1)))
            yield Hit(
                f"images/{name}",
                "an image that shows something",
                f"one colour, #{red:02x}{green:02x}{blue:02x}",
            )


def _headers(scene: RawScene) -> Iterator[tuple[str, Header]]:
    """The images with a good header."""
    return ((name, header) for name, header in scene.headers.items() if header.problem is None)
