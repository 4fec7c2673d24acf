"""Headers of image files, digests of their bytes and pixels, and thumbnails."""

from __future__ import annotations

import hashlib
import os
import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, TypeVar

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.errors import ImageError
from chronoscene.images.decoding import is_covered, is_transparent, load_rgb, stored_size
from chronoscene.images.exif import ExifData, exif_of
from chronoscene.io.staging import sha256_of
from chronoscene.scene.grouping import grouped

T = TypeVar("T")
Track = Callable[[Sequence[T], str], Iterable[T]]
"""Passes items on and shows the progress under a description."""

THUMBNAIL = 32  # Pixels along each side of a thumbnail
GREY_SIDE = 160  # Pixels along the longer side of a small grey image: 20 kB for each image

END_MARKS = {"JPEG": b"\xff\xd9", "MPO": b"\xff\xd9", "PNG": b"IEND"}
"""End markers of files. Compressed JPEG data cannot contain its own."""

JPEG = ("JPEG", "MPO")  # Pillow's names of JPEG files
TAIL = 4096  # Bytes at the end of a file in which its end marker is looked for

_HEADER_THREADS = 4
_MIN_THREADED = 32  # Fewer headers than this are read before threads have started

_START, _SCAN, _END = b"\xff\xd8", 0xDA, 0xD9
_RESTART_INTERVAL = 0xDD

_SEGMENTS = frozenset({0xC4, 0xDA, 0xDB, 0xDC, 0xDD, 0xFE, *range(0xE0, 0xF0)})
"""Markers that may occur between two scans: tables, comments, the next scan."""

PADDING = 64  # Number of equal bytes that compressed data never ends in


@dataclass(frozen=True, slots=True)
class Header:
    """Content of the header of an image file."""

    problem: str | None
    """Reason why it is not a readable image; then the rest is meaningless."""
    size: tuple[int, int] = (0, 0)
    """Width and height as stored."""
    mode: str = ""
    """Pillow's name of the type of pixels."""
    orientation: int = 1
    """EXIF orientation; 1 is upright."""
    kind: str = ""
    """Pillow's name of the file format."""
    deep: bool = False
    """True if it has more than 8 bits per channel."""
    transparent: bool = False
    """True if it may have transparent pixels."""
    truncated: bool = False
    """True if the file ends before its image does."""
    exif: ExifData = field(default_factory=ExifData)


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """Digests and thumbnails of a decoded image."""

    problem: str | None
    """Reason why it cannot be decoded; then the rest is None."""
    digest: bytes | None = None
    """SHA-256 of size and RGB bytes."""
    thumbnail: NDArray[np.float32] | None = None
    """Mean colours, 0..255. [32, 32, 3]"""
    grey: NDArray[np.uint8] | None = None
    """Mean brightness, at most `GREY_SIDE` pixels along its longer side. [h, w]"""


def read_headers(folder: Path, names: Sequence[str]) -> dict[str, Header]:
    """Read the headers of images below a folder, in several threads: a disk may be slow."""
    paths = [folder / name for name in names]
    with warnings.catch_warnings(action="ignore"):  # on large images and odd metadata
        if len(paths) < _MIN_THREADED:
            return dict(zip(names, map(read_header, paths), strict=True))
        with ThreadPoolExecutor(_HEADER_THREADS) as pool:
            return dict(zip(names, pool.map(read_header, paths), strict=True))


def read_header(path: Path) -> Header:
    """Read the header of one image; never raises for what is in the file."""
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size == 0:
                return Header("an empty file")
            with Image.open(file) as image:
                return _header(path, file, image)
    except Exception as error:  # damaged files make Pillow raise almost anything
        return Header(_problem(error))


def _header(path: Path, file: BinaryIO, image: Image.Image) -> Header:
    exif, kind = exif_of(image), image.format or ""
    return Header(
        problem=None,
        size=stored_size(image),
        mode=image.mode,
        orientation=exif.orientation,
        kind=kind,
        deep=_is_deep(image),
        transparent=is_transparent(image),
        truncated=_is_truncated(path, file, image),
        exif=exif,
    )


def _is_deep(image: Image.Image) -> bool:
    """Return True if the file has more than 8 bits per channel."""
    if image.mode in ("F", "I") or image.mode.startswith("I;"):
        return True
    tiles = getattr(image, "tile", None) or ((),)
    return any(";16" in str(argument) for argument in tiles[0][3:])


def _is_truncated(path: Path, file: BinaryIO, image: Image.Image) -> bool:
    """Return True if a file ends before its image does.

    A file that does not end in its marker may still be complete: phones append other data. Only
    such files are read completely and, if the marker is really missing, decoded.
    """
    if not is_covered(image):
        return True
    kind = image.format or ""
    size = file.seek(0, os.SEEK_END)
    mark = END_MARKS.get(kind)
    if mark is None:
        return False
    file.seek(max(0, size - TAIL))
    if mark in file.read():
        return False
    if kind in JPEG:
        file.seek(0)
        if has_end(file.read()):
            return False
    return read_pixels_of(path).problem is not None


def jpeg_damage(data: bytes) -> str | None:
    """Describe damage to the compressed data of a JPEG file that decoders silently accept.

    libjpeg decodes almost anything: parts that a broken transfer filled with zeros become grey or
    stripes, without an error. The structure of the file reveals them.

    Args:
        data: The whole file. Everything after the end of its first image is ignored.

    Source: ITU-T T.81, annex B (markers) and F.1.2.3 (in compressed data, 255 is followed by 0).
    """
    at, has_restarts = _first_scan(data)
    if at is None:
        return None  # decoders report a missing scan
    codes = np.frombuffer(data, np.uint8)
    marks = np.flatnonzero(codes[at:-1] == 0xFF) + at
    follow = codes[marks + 1]
    plain = (follow == 0) | (follow == 0xFF)
    if has_restarts:
        plain |= (follow >= 0xD0) & (follow <= 0xD7)
    skip = at
    for mark in marks[~plain].tolist():
        marker = data[mark + 1]
        if mark < skip:
            continue
        if marker == _END:
            return None
        if marker not in _SEGMENTS:
            return f"compressed data with an impossible marker at byte {mark}"
        skip = mark + 2 + int.from_bytes(data[mark + 2 : mark + 4])
    if len(set(data[-PADDING:])) == 1:
        return f"no end of the image, and only {data[-1]:#04x} in the last bytes"
    return None


def has_end(data: bytes) -> bool:
    """Return True if the marker that ends an image follows the beginning of the compressed data."""
    at, _ = _first_scan(data)
    return at is not None and data.find(bytes((0xFF, _END)), at) >= 0


def _first_scan(data: bytes) -> tuple[int | None, bool]:
    """Find the start of the compressed data; return True, too, if it contains restart markers."""
    at, restarts = len(_START), False
    while data.startswith(_START) and at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF:  # a fill byte
            at += 1
            continue
        restarts |= marker == _RESTART_INTERVAL
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
        if marker == _SCAN:
            return at, restarts
    return None, restarts


def hash_files(folder: Path, names: Sequence[str], track: Track) -> dict[str, str]:
    """Compute the SHA-256 of the files that have the same size as another one."""
    by_size = grouped((_size(folder / name), name) for name in names)
    same = [name for group in by_size.values() if len(group) > 1 for name in group]
    digests = {name: _digest(folder / name) for name in track(same, "equal files")}
    return {name: digest for name, digest in digests.items() if digest is not None}


def read_pixels(folder: Path, names: Sequence[str], track: Track) -> dict[str, Pixels]:
    """Decode images in several threads, a few at a time.

    Pillow decodes without Python's lock: 484 photos of 0.5 to 0.7 megapixels took 2.2 s in two
    threads, 2.6 s in two processes.
    """
    threads = os.cpu_count() or 2
    found: dict[str, Pixels] = {}
    with warnings.catch_warnings(action="ignore"), ThreadPoolExecutor(threads) as pool:
        # Only a few are submitted at a time, so that an interruption does not wait for all of them.
        waiting: list[tuple[str, Any]] = []
        for name in track(names, "decode images"):
            waiting.append((name, pool.submit(read_pixels_of, folder / name)))
            if len(waiting) > 2 * threads:
                first, future = waiting.pop(0)
                found[first] = future.result()
        found.update((name, future.result()) for name, future in waiting)
    return found


def read_pixels_of(path: Path) -> Pixels:
    """Decode one image; never raises for what is in the file."""
    try:
        rgb = load_rgb(path)
    except ImageError as error:
        return Pixels(error.found.replace(f" {str(path)!r}", ""))  # the place names the file
    except Exception as error:  # damaged files make Pillow raise almost anything
        return Pixels(_problem(error))
    if (damage := jpeg_damage(path.read_bytes())) is not None:
        return Pixels(damage)
    digest = hashlib.sha256(repr(rgb.shape).encode() + rgb.tobytes()).digest()
    small = Image.fromarray(rgb).resize((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
    grey = Image.fromarray(rgb).convert("L")
    scale = min(1.0, GREY_SIDE / max(grey.size))
    size = max(1, round(grey.width * scale)), max(1, round(grey.height * scale))
    grey = grey.resize(size, Image.Resampling.BOX)
    return Pixels(None, digest, np.asarray(small, np.float32), np.asarray(grey))


def _problem(error: Exception) -> str:
    known = error.strerror if isinstance(error, OSError) else None
    return known or re.sub(r" ?<_io\.[^>]*>", "", str(error)) or type(error).__name__


def _size(path: Path) -> int:
    with suppress(OSError):
        return os.path.getsize(path)
    return -1


def _digest(path: Path) -> str | None:
    with suppress(OSError):
        return sha256_of(path)
    return None
