"""Features and matches in a database of COLMAP, of any version; the file is only read.

SQLite opens it as immutable, so that no journal appears beside it, and runs nothing that is
defined in it.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from chronoscene.registration.features.given.image_features import ImageFeatures, check_size, wrong

MAX_IMAGES = 2**31 - 1  # COLMAP's; the id of a pair is MAX_IMAGES * first + second
TABLES = ("cameras", "images", "keypoints", "descriptors", "matches", "two_view_geometries")
SIFT = 0  # COLMAP's number of this kind of features


class ColmapDatabase:
    """One database."""

    is_coarse = False

    def __init__(self, path: Path) -> None:
        self.path = path
        journal = Path(f"{path}-wal")
        if journal.exists() and journal.stat().st_size:
            raise wrong(str(path), "a database that is closed", f"a journal beside it, {journal}",
                        "end the program that has it open")  # fmt: skip
        rows = self._rows("SELECT name FROM sqlite_master WHERE type = 'table'")
        if missing := sorted(set(TABLES[:3]) - {str(name) for (name,) in rows}):
            raise wrong(str(path), "a database of COLMAP", f"no table {missing[0]}")
        self.tables = {str(name) for (name,) in rows} & set(TABLES)
        self.images = {
            str(name): (int(i), (int(width), int(height)))
            for i, name, width, height in self._rows(
                "SELECT image_id, name, width, height FROM images JOIN cameras USING (camera_id)"
            )
        }

    @property
    def names(self) -> list[str]:
        """Photos with keypoints, or without any."""
        return list(self.images)

    def features(self, name: str) -> ImageFeatures:
        """Features of a photo."""
        image, size = self.images[name]
        found = self._array("keypoints", image, np.float32)
        keypoints = np.zeros((0, 6), np.float32) if found is None else found
        descriptors: np.ndarray | None = None
        if "descriptors" in self.tables and len(keypoints):
            descriptors = self._array("descriptors", image, np.uint8)
        if descriptors is not None and self._kind(image) != SIFT:
            if descriptors.shape[1] % 4:
                raise wrong(f"{self.path}: {name}", "descriptors of floats", "a part of one")
            descriptors = descriptors.view(np.float32)
        return ImageFeatures(keypoints, descriptors, size)

    def matches(self, names: Iterable[str]) -> Iterator[tuple[str, str, np.ndarray]]:
        """Photos of each pair, and their matches; verified ones where there are no others."""
        known = set(names)
        by_id = {image: name for name, (image, _) in self.images.items() if name in known}
        done = set()
        for table in ("matches", "two_view_geometries"):
            if table not in self.tables:
                continue
            for (pair_id,) in self._rows(f"SELECT pair_id FROM {table} WHERE rows > 0"):
                a, b = divmod(int(pair_id), MAX_IMAGES)
                if pair_id in done or a not in by_id or b not in by_id:
                    continue
                done.add(pair_id)
                rows = self._array(table, int(pair_id), np.uint32)
                if rows is not None:
                    yield by_id[a], by_id[b], rows.astype(np.int64)

    def _kind(self, image: int) -> int:
        columns = {str(row[1]) for row in self._rows("PRAGMA table_info(descriptors)")}
        if "type" not in columns:
            return SIFT
        return int(self._rows("SELECT type FROM descriptors WHERE image_id = ?", image)[0][0])

    def _array(self, table: str, key: int, dtype: type) -> np.ndarray | None:
        """Matrix in a row of a table; None without one."""
        column = "pair_id" if table in TABLES[4:] else "image_id"
        found = self._rows(f"SELECT rows, cols, data FROM {table} WHERE {column} = ?", key)
        if not found or not found[0][0]:
            return None
        rows, columns, data = found[0]
        place = f"{self.path}: {table}, {column} {key}"
        if not isinstance(rows, int) or not isinstance(columns, int) or min(rows, columns) < 0:
            raise wrong(place, "numbers of rows and columns", f"{rows!r} and {columns!r}")
        check_size(place, (rows, columns))
        size = rows * columns * np.dtype(dtype).itemsize
        if not isinstance(data, bytes) or len(data) != size:
            raise wrong(place, f"{size} bytes", "another number of them")
        return np.frombuffer(data, dtype).reshape(rows, columns).copy()

    def _rows(self, query: str, *values: int) -> list[tuple[Any, ...]]:
        try:
            uri = f"file:{quote(str(self.path.resolve()))}?mode=ro&immutable=1"
            with closing(sqlite3.connect(uri, uri=True)) as opened:
                opened.execute("PRAGMA trusted_schema = OFF")
                return opened.execute(query, values).fetchall()
        except (sqlite3.Error, OverflowError) as error:
            raise wrong(str(self.path), "a database of COLMAP", f"{error}") from error
