"""One way to decode images, and to find out which of their pixels count.

Orientation tags are not applied: COLMAP works on the pixels as stored, and so do the poses.

Pixels that the mask of an image ignores, or whose alpha is below one half, do not count. Colours
are those of the file: nothing is put behind transparent pixels.
"""

from __future__ import annotations

import struct
import zlib
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import ExifTags, Image

from chronoscene.errors import ImageError
from chronoscene.images.masks import MODES, resize_mask
from chronoscene.io.documents import plain_file

_UNDO_ORIENTATION = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_90,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_270,
}
"""Orientation tag to the operation that takes Pillow's rotation of a TIFF back."""

_DECODE_ERRORS = (
    OSError,  # also what Pillow raises for unknown and truncated files
    ValueError,
    SyntaxError,  # broken PNG chunks
    TypeError,
    KeyError,
    IndexError,
    EOFError,
    MemoryError,
    OverflowError,
    RuntimeError,  # from the AVIF decoder
    struct.error,
    zlib.error,
    Image.DecompressionBombError,
)

HEIF_SUFFIXES = (".heic", ".heif")
HEIF_TODO = "pip install 'chronoscene[heic]', or convert them to JPEG"

Photo = tuple[NDArray[np.uint8], NDArray[np.bool_] | None]
"""Colours, and a mask of those that count; see `load_photo`. [H, W, 3], [H, W]"""


@cache
def reads_heif() -> bool:
    """Let Pillow read HEIC and HEIF files from now on; False without the extra ``heic``.

    These are decoded upright, and their orientation tag is then 1.
    """
    try:
        from pillow_heif import register_heif_opener
    except ImportError:
        return False
    register_heif_opener()
    return True


def image_size(path: Path) -> tuple[int, int]:
    """Read width and height of the stored pixels from the header.

    Raises:
        ImageError: If the file is missing or not an image.
    """
    try:
        with Image.open(plain_file(path)) as image:
            return stored_size(image)
    except _DECODE_ERRORS as error:
        raise _image_error(path, error) from error


def load_rgb(path: Path, *, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Decode any image to RGB; arguments and errors as for `load_photo`. [H, W, 3]"""
    return load_photo(path, size=size)[0]


def load_opaque(path: Path, *, size: tuple[int, int] | None = None) -> NDArray[np.uint8]:
    """Decode an image as `load_rgb` does, if alpha is 255 everywhere. [H, W, 3]

    Raises:
        ImageError: As for `load_photo`, and if any pixel is transparent, if only a little.
    """
    pixels = load_rgb(path, size=size)
    with Image.open(path) as image:
        if is_transparent(image) and np.asarray(image.convert("RGBA"))[..., 3].min() < 255:
            raise ImageError(
                path,
                expected="an image without transparent pixels",
                found="an alpha channel below 255",
                todo="render it over the background that the photos show, and save it as RGB",
            )
    return pixels


def load_photo(
    path: Path, mask_path: Path | None = None, *, size: tuple[int, int] | None = None
) -> Photo:
    """Decode any image to RGB, and find out which of its pixels count.

    Args:
        path: The image.
        mask_path: Its mask file, if it has one.
        size: Width and height to resize to; None to keep the file's.

    Returns:
        image: Colours of the file, also where it is transparent. [H, W, 3]
        mask: Where the mask file and alpha allow it, by the rule of `resize_mask`; None where all
            pixels count. [H, W]

    Raises:
        ImageError: If a file is missing or damaged, the image of a kind that has no plain colours,
            or the mask not of one channel, or not of the size of the image.
    """
    try:
        with Image.open(plain_file(path)) as image:
            decoded = _decode(image)
            rgb, mask = _to_rgb(decoded), _opaque(decoded)
    except _DECODE_ERRORS as error:
        raise _image_error(path, error) from error
    if mask_path is not None:
        allowed = load_mask(mask_path, rgb.size)
        mask = allowed if mask is None else mask & allowed
    if size is not None and rgb.size != size:
        rgb = rgb.resize(size, Image.Resampling.BICUBIC)
        mask = mask if mask is None else resize_mask(mask, size)
    return np.array(rgb), None if mask is None or mask.all() else mask


def load_mask(path: Path, size: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask file: True where it is not 0; errors as for `load_grey`. [H, W]"""
    return load_grey(path, size) != 0


def load_grey(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read the values of a mask file. [H, W]

    Raises:
        ImageError: If it is missing, damaged, not of one channel, or of another width and height.
    """
    try:
        with Image.open(plain_file(path)) as image:
            found = f"{image.width} x {image.height} pixels of mode {image.mode}"
            if image.size == size and image.mode in MODES:
                return np.asarray(image, np.uint8)
    except _DECODE_ERRORS as error:
        raise _image_error(path, error) from error
    raise ImageError(
        path,
        expected=f"a mask of {size[0]} x {size[1]} pixels as its image, one channel of 8 bits",
        found=found,
        todo="save the mask again as a grey PNG at the size of the image",
    )


def _orientation(image: Image.Image) -> int:
    value = image.getexif().get(ExifTags.Base.Orientation, 1)
    return value if value in _UNDO_ORIENTATION else 1


def stored_size(image: Image.Image) -> tuple[int, int]:
    """Return width and height of the pixels as stored; Pillow gives those of a rotated TIFF."""
    width, height = image.size
    turned = image.format == "TIFF" and _orientation(image) >= 5
    return (height, width) if turned else (width, height)


def is_covered(image: Image.Image) -> bool:
    """Return False for a TIFF file with rows or columns that no strip or tile has.

    Pillow leaves them black, however many are announced.
    """
    if image.format != "TIFF":
        return True
    width, height = stored_size(image)
    ends = [box[2:] for _, box, *_ in getattr(image, "tile", ())]
    return any(x >= width for x, _ in ends) and any(y >= height for _, y in ends)


def _decode(image: Image.Image) -> Image.Image:
    """Decode the pixels as stored; the rotation of TIFF files by Pillow is undone."""
    if not is_covered(image):
        raise ValueError(f"no data for all of its {image.width} x {image.height} pixels")
    orientation = _orientation(image) if image.format == "TIFF" else 1
    image.load()
    if orientation == 1:
        return image
    return image.transpose(_UNDO_ORIENTATION[orientation])


def _to_rgb(image: Image.Image) -> Image.Image:
    if image.mode.startswith("I"):
        image = _from_16_bit(image)
    if image.mode == "F":
        raise ValueError("pixels that are floating point numbers")
    return (image.convert("RGBA") if is_transparent(image) else image).convert("RGB")


def is_transparent(image: Image.Image) -> bool:
    """Return True for an alpha channel, or one transparent colour."""
    return "transparency" in image.info or image.mode in ("RGBA", "LA", "PA", "RGBa", "La")


def _opaque(image: Image.Image) -> NDArray[np.bool_] | None:
    """Return True where alpha is one half or more; None if there is none. [H, W]"""
    if not is_transparent(image):
        return None
    if image.mode.startswith("I"):  # one transparent value of 16 bits, which Pillow ignores
        return np.asarray(image) != image.info["transparency"]
    return np.asarray(image.convert("RGBA"))[..., 3] >= 128


def _from_16_bit(image: Image.Image) -> Image.Image:
    """Convert grey values 0..65535 to 0..255, rounded to the nearest."""
    values = np.asarray(image).astype(np.int64)
    if values.size and not 0 <= values.min() <= values.max() <= 65535:
        raise ValueError("grey values outside 0..65535")
    return Image.fromarray(((values * 255 + 32767) // 65535).astype(np.uint8))


def _image_error(path: Path, error: BaseException) -> ImageError:
    if isinstance(error, FileNotFoundError):
        return ImageError(path, expected="an image", found="nothing", todo="copy the image there")
    return ImageError(
        path,
        expected="an image that can be decoded",
        found=str(error) or type(error).__name__,
        todo="copy the file again, or convert it to JPEG or PNG",
    )
