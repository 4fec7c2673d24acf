"""What the validator reads of image files: headers, digests of bytes and pixels, thumbnails."""

from __future__ import annotations

import hashlib
import os
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from chronoscene.errors import ImageError
from chronoscene.images import image_size, load_rgb

THUMBNAIL = 32
"""Pixels along each side of a thumbnail."""

_ORIENTATION_TAG = 0x0112


@dataclass(frozen=True, slots=True)
class Header:
    """What the first bytes of an image file say."""

    problem: str | None
    """Why it is not a readable image; then the rest means nothing."""
    size: tuple[int, int] = (0, 0)
    """Width and height as stored."""
    mode: str = ""
    """Pillow's name of the kind of pixels."""
    orientation: int = 1
    """EXIF orientation; 1 is upright."""


@dataclass(frozen=True, slots=True, eq=False)
class Pixels:
    """What is kept of a decoded image."""

    problem: str | None
    """Why it cannot be decoded; then the rest is None."""
    digest: bytes | None = None
    """SHA-256 of size and RGB bytes."""
    thumbnail: NDArray[np.float32] | None = None
    """Mean colours, 0..255. [32, 32, 3]"""


def read_headers(folder: Path, names: Iterable[str]) -> dict[str, Header]:
    """Headers of some images below a folder."""
    with _quiet():
        return {name: read_header(folder / name) for name in names}


def read_header(path: Path) -> Header:
    """Header of one image; never raises for what is in the file."""
    try:
        if os.path.getsize(path) == 0:
            return Header("an empty file")
        size = image_size(path)
        with Image.open(path) as image:
            return Header(None, size, image.mode, _orientation(image))
    except ImageError as error:
        return Header(_without_path(error.found, path))
    except OSError as error:
        return Header(error.strerror or "an error")


def hash_files(
    folder: Path, names: Sequence[str], track: Callable[[Sequence[str], str], Iterable[str]]
) -> dict[str, bytes]:
    """SHA-256 of the files that have the same size as another one."""
    by_size: dict[int, list[str]] = {}
    for name in names:
        by_size.setdefault(_size(folder / name), []).append(name)
    same = [name for group in by_size.values() if len(group) > 1 for name in group]
    digests = {name: _digest(folder / name) for name in track(same, "equal files")}
    return {name: digest for name, digest in digests.items() if digest is not None}


def read_pixels(
    folder: Path, names: Sequence[str], track: Callable[[Sequence[str], str], Iterable[str]]
) -> dict[str, Pixels]:
    """Decode images in several threads, a few at a time."""
    threads = os.cpu_count() or 2
    found: dict[str, Pixels] = {}
    with _quiet(), ThreadPoolExecutor(threads) as pool:
        # Only so many are handed out that an interruption does not wait for all of them.
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
        return Pixels(_without_path(error.found, path))
    digest = hashlib.sha256(repr(rgb.shape).encode() + rgb.tobytes()).digest()
    small = Image.fromarray(rgb).resize((THUMBNAIL, THUMBNAIL), Image.Resampling.BOX)
    return Pixels(None, digest, np.asarray(small, np.float32))


def _orientation(image: Image.Image) -> int:
    try:
        value = image.getexif().get(_ORIENTATION_TAG, 1)
    except Exception:  # damaged EXIF raises almost anything, and says nothing about the pixels
        return 1
    return value if isinstance(value, int) else 1


def _without_path(text: str, path: Path) -> str:
    """Pillow's message without the path, which the place of the finding has already."""
    return text.replace(repr(str(path)), "it")


def _size(path: Path) -> int:
    try:
        return os.path.getsize(path)
    except OSError:
        return -1


def _digest(path: Path) -> bytes | None:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").digest()
    except OSError:
        return None


@contextmanager
def _quiet() -> Iterator[None]:
    """Without Pillow's warnings on large images and odd metadata."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield
