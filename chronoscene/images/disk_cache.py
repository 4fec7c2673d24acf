"""Decoded photos on disk, so that large files are decoded and resized once and not in every pass.

Each is a file that is named for the content of photo and mask, their size, and the decoder: what
it gives is what decoding would give. Files appear complete or not at all, and one that is damaged
or missing is made again, so that the folder may be deleted at any time and be used by several
processes.
"""

from __future__ import annotations

import os
import threading
import time
from contextlib import suppress
from hashlib import sha256
from pathlib import Path
from zipfile import BadZipFile

import numpy as np
import PIL

from chronoscene.errors import DiskFullError
from chronoscene.images.decoding import Photo, load_photo
from chronoscene.io.staging import replacing, sha256_of

_FORMAT = 1  # Of the files; to be raised when they, or the rules of decoding, change
_HEADERS = 2048  # Bytes that a file has besides its arrays, at most
UNREADABLE = (OSError, ValueError, KeyError, EOFError, RuntimeError, BadZipFile)
"""Exceptions that damaged files raise."""
_NO_MASK = np.zeros((0, 0), bool)  # In files of photos that count everywhere


class DiskCache:
    """Photos at one size each, in a folder. Thread-safe."""

    def __init__(self, folder: Path, limit: int) -> None:
        """Set up a cache; read and write nothing yet.

        Args:
            folder: For this purpose alone; made when it is needed.
            limit: Bytes that the files may take. Those that were used before this object was made
                go first, the one unused for longest before the others. Where all are newer, no
                more photos are kept.
        """
        self.folder = folder
        self._limit = limit
        self._made = time.time()
        self._files: dict[tuple[Path, Path | None, tuple[int, int]], Path] = {}
        self._lock = threading.Lock()

    def load(self, path: Path, mask_path: Path | None, *, size: tuple[int, int]) -> Photo:
        """Return the result of `load_photo`, with its arguments and errors."""
        try:
            file = self._file(path, mask_path, size)
        except OSError:
            return load_photo(path, mask_path, size=size)  # which says what is wrong
        photo = _read(file, size)
        if photo is None:
            photo = load_photo(path, mask_path, size=size)
            self._keep(file, photo)
        return photo

    def _file(self, path: Path, mask_path: Path | None, size: tuple[int, int]) -> Path:
        """Return the file of a photo, whose content is hashed once."""
        place = path, mask_path, size
        if place not in self._files:
            contents = sha256_of(path), sha256_of(mask_path) if mask_path else None
            key = repr((_FORMAT, PIL.__version__, size, *contents))
            self._files[place] = self.folder / f"{sha256(key.encode()).hexdigest()}.npz"
        return self._files[place]

    def _keep(self, file: Path, photo: Photo) -> None:
        image, mask = photo
        if mask is None:
            mask = _NO_MASK
        with self._lock:
            try:
                self.folder.mkdir(parents=True, exist_ok=True)
                if self._free(_HEADERS + image.nbytes + mask.nbytes):
                    with replacing(file) as partial, partial.open("wb") as stream:
                        np.savez(stream, image=image, mask=mask)
            except (OSError, DiskFullError):
                return  # the photo is decoded again when it is needed again

    def _free(self, size: int) -> bool:
        """Delete old files for a new one of this size; return True if it fits."""
        files = files_of(self.folder)
        total = sum(stat.st_size for stat in files.values())
        for path, stat in sorted(files.items(), key=lambda item: item[1].st_mtime):
            if total + size <= self._limit or stat.st_mtime >= self._made:
                break
            path.unlink(missing_ok=True)
            total -= stat.st_size
        return total + size <= self._limit


def files_of(folder: Path) -> dict[Path, os.stat_result]:
    """List the files of a cache, without those that another process deletes meanwhile."""
    files = {}
    for path in folder.glob("*"):
        with suppress(FileNotFoundError):
            files[path] = path.stat()
    return files


def _read(file: Path, size: tuple[int, int]) -> Photo | None:
    """Read a photo of this size; None if it is absent or damaged, which its check sums show."""
    try:
        os.utime(file)  # It is in use
        with np.load(file) as arrays:
            image, mask = arrays["image"], arrays["mask"]
    except UNREADABLE:
        return None
    shape = size[1], size[0]
    if (image.shape, image.dtype) != ((*shape, 3), np.uint8) or mask.dtype != bool:
        return None
    if mask.shape not in (shape, _NO_MASK.shape):
        return None
    return image, mask if mask.size else None
