"""Files of hloc (Sarlin et al. 2019): ``features.h5`` and ``matches.h5``.

A photo is a group, whose name may have slashes, with ``keypoints`` [K, 2], ``descriptors`` [D, K]
and ``image_size``; the centre of the first pixel is (0, 0). A pair is a group ``a/b``, in older
files ``a_b``, of names with ``-`` for slashes, with ``matches0``: for each keypoint of ``a`` that
of ``b``, or -1. Links to other places and files are not followed.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.checks import import_extra
from chronoscene.registration.features.given.image_features import ImageFeatures, check_size, wrong


class HlocFile:
    """One file, open for reading."""

    def __init__(self, path: Path) -> None:
        h5py = import_extra("h5py", "hloc", str(path))
        self.path = path
        try:
            self.file = h5py.File(path, "r")
            self.groups: dict[str, list[str]] = {}
            self.file.visititems(self._add)
        except (OSError, RuntimeError) as error:
            raise wrong(str(path), "a file of HDF5", f"one that is damaged ({error})") from error

    def _add(self, name: str, item: Any) -> None:
        group, _, key = name.rpartition("/")
        if hasattr(item, "dtype") and group:
            self.groups.setdefault(group, []).append(key)

    @property
    def names(self) -> list[str]:
        """Photos with keypoints."""
        return [name for name, keys in self.groups.items() if "keypoints" in keys]

    @property
    def is_coarse(self) -> bool:
        """True if positions are stored in 16 bits: exact to half a pixel from 1,024 on."""
        names = self.names
        return bool(names) and self.file[f"{names[0]}/keypoints"].dtype.itemsize < 4

    def features(self, name: str) -> ImageFeatures:
        """Features of a photo."""
        has = self.groups[name]
        xy = self._read(f"{name}/keypoints").astype(np.float32)
        if xy.ndim == 2:
            xy = np.concatenate([xy[:, :2] + np.float32(0.5), xy[:, 2:]], axis=1)
        descriptors = None
        if "descriptors" in has:
            descriptors = np.ascontiguousarray(self._read(f"{name}/descriptors").T, np.float32)
        size = None
        if "image_size" in has:
            numbers = self._read(f"{name}/image_size").ravel().tolist()
            size = (int(numbers[0]), int(numbers[1])) if len(numbers) == 2 else None
        return ImageFeatures(xy, descriptors, size)

    def matches(self, names: Iterable[str]) -> Iterator[tuple[str, str, np.ndarray]]:
        """Photos of each pair, and the matches between their keypoints. [M, 2]"""
        flat: dict[str, str] = {}
        for name in names:
            if (other := flat.setdefault(name.replace("/", "-"), name)) != name:
                raise wrong(
                    str(self.path), "photos whose names differ where hloc writes - for /",
                    f"{other} and {name}", "rename one of the photos",
                )  # fmt: skip
        for group, keys in self.groups.items():
            if "matches0" not in keys or (pair := _pair(group, flat)) is None:
                continue
            place = f"{group}/matches0"
            to = self._read(place)
            if to.ndim != 1 or to.dtype.kind not in "iu":
                raise wrong(f"{self.path}: {place}", "an index per keypoint", f"shape {to.shape}")
            rows = np.flatnonzero(to != -1)
            yield *pair, np.column_stack([rows, to[rows].astype(np.int64)])

    def _read(self, name: str) -> np.ndarray:
        """Read a small array of numbers that is in this file."""
        item = self.file[name]
        place = f"{self.path}: {name}"
        if item.dtype.kind not in "fiu" or item.is_virtual or item.external:
            raise wrong(place, "numbers in this file", f"{item.dtype}, or a link to another file")
        check_size(place, item.shape)
        try:
            return np.asarray(item[()])
        except (OSError, RuntimeError) as error:
            raise wrong(place, "an array", f"one that is damaged ({error})") from error


def _pair(group: str, flat: dict[str, str]) -> tuple[str, str] | None:
    """Names of the two photos of a group; None if they are not in the features."""
    for separator in ("/", "_"):
        parts = group.split(separator)
        for i in range(1, len(parts)):
            a, b = separator.join(parts[:i]), separator.join(parts[i:])
            if a in flat and b in flat:
                return flat[a], flat[b]
    return None
