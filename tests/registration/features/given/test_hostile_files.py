"""Files of strangers: each ends in one message, and nothing outside of them is read."""

import sqlite3
import sys
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from chronoscene.errors import ChronoSceneError
from chronoscene.registration.features.given.colmap_database import ColmapDatabase
from chronoscene.registration.features.given.hloc import HlocFile
from chronoscene.registration.features.given.image_features import (
    ImageFeatures,
    checked,
    checked_matches,
)
from chronoscene.registration.features.given.source import find_sources


def write(path: Path, fill: Callable[[h5py.Group], object]) -> Path:
    with h5py.File(path, "w") as file:
        fill(file.create_group("a.jpg"))
    return path


def external(group: h5py.Group) -> None:
    group.create_dataset("keypoints", (4, 2), "f4", external=[("/etc/passwd", 0, 32)])


HOSTILE = {
    "huge": lambda g: g.create_dataset("keypoints", (2**31, 2), "f4", chunks=(1024, 2)),
    "deep": lambda g: g.create_dataset("keypoints", (2, 2, 2), "f4"),
    "texts": lambda g: g.create_dataset("keypoints", data=["a", "b"]),
    "external": external,
}


@pytest.mark.parametrize("kind", HOSTILE)
def test_arrays_that_no_photo_has_are_refused(kind: str, tmp_path: Path) -> None:
    file = HlocFile(write(tmp_path / "f.h5", HOSTILE[kind]))
    with pytest.raises(ChronoSceneError, match=r"f\.h5: a\.jpg/keypoints"):
        file.features("a.jpg")


def test_links_are_not_followed(tmp_path: Path) -> None:
    other = write(tmp_path / "other.h5", lambda g: g.create_dataset("keypoints", (2, 2), "f4"))
    with h5py.File(tmp_path / "f.h5", "w") as file:
        file["b.jpg"] = h5py.ExternalLink(str(other), "a.jpg")
    assert HlocFile(tmp_path / "f.h5").names == []


def test_damaged_files_end_in_one_message(tmp_path: Path) -> None:
    path = write(tmp_path / "f.h5", lambda g: g.create_dataset("keypoints", (9, 2), "f4"))
    path.write_bytes(path.read_bytes()[:600])
    with pytest.raises(ChronoSceneError, match="damaged"):
        HlocFile(path)
    (tmp_path / "x.pkl").write_bytes(b"\x80\x04K\x01.")
    with pytest.raises(ChronoSceneError, match="a file of HDF5 or SQLite"):
        find_sources(str(tmp_path / "x.pkl"), None)


def make_database(path: Path, *statements: str) -> Path:
    opened = sqlite3.connect(path)
    opened.executescript(
        "CREATE TABLE cameras (camera_id INTEGER, width INTEGER, height INTEGER);"
        "CREATE TABLE images (image_id INTEGER, name TEXT, camera_id INTEGER);"
        "INSERT INTO cameras VALUES (1, 40, 30); INSERT INTO images VALUES (1, 'a.jpg', 1);"
        + ";".join(statements)
    )
    opened.close()
    return path


KEYPOINTS = "CREATE TABLE keypoints (image_id, rows, cols, data)"


@pytest.mark.parametrize(
    ("row", "found"),
    [
        ("1, 2, 2, x'00'", "16 bytes"),
        ("1, 'many', 2, x'00'", "numbers of rows"),
        ("1, -5, 2, x'00'", "numbers of rows"),
        (f"1, {2**40}, 2, x'00'", "the features or matches of a photo"),
        ("1, 1, 1, 'text'", "4 bytes"),
    ],
)
def test_rows_that_lie_are_refused(row: str, found: str, tmp_path: Path) -> None:
    path = make_database(tmp_path / "d.db", KEYPOINTS, f"INSERT INTO keypoints VALUES ({row})")
    with pytest.raises(ChronoSceneError, match=found):
        ColmapDatabase(path).features("a.jpg")


def test_views_in_place_of_tables_are_refused(tmp_path: Path) -> None:
    endless = (
        "CREATE VIEW keypoints AS WITH RECURSIVE r(i) AS (SELECT 1 UNION ALL SELECT i + 1 FROM r) "
        "SELECT i AS image_id, 1 AS rows, 1 AS cols, x'00' AS data FROM r"
    )
    with pytest.raises(ChronoSceneError, match="no table keypoints"):
        ColmapDatabase(make_database(tmp_path / "d.db", endless))


def test_an_open_database_is_refused(tmp_path: Path) -> None:
    path = make_database(tmp_path / "d.db", KEYPOINTS)
    (tmp_path / "d.db-wal").write_bytes(b"x")
    with pytest.raises(ChronoSceneError, match="a journal beside it"):
        ColmapDatabase(path)


@pytest.mark.parametrize(
    ("xy", "descriptors", "size", "found"),
    [
        ([[1, np.nan]], None, None, "NaN"),
        ([[1, 2]], [[np.inf]], None, "NaN or infinity"),
        ([[1, 2]], [[1.0], [2.0]], None, "descriptors of 1 keypoints"),
        ([[1, 200]], None, None, "up to 1, 200"),
        ([[1, 2]], None, (30, 40), "found 30 x 40"),
        ([[1, 2, 3]], None, None, "2, 4 or 6 columns"),
    ],
)
def test_features_of_other_photos_are_refused(
    xy: list[list[float]], descriptors: list[list[float]] | None, size: tuple[int, int] | None,
    found: str,
) -> None:  # fmt: skip
    values = None if descriptors is None else np.array(descriptors, np.float32)
    features = ImageFeatures(np.array(xy, np.float32), values, size)
    with pytest.raises(ChronoSceneError, match=found):
        checked("f", features, (40, 30))


def test_matches_of_other_features_are_refused() -> None:
    rows = np.array([[3, 1], [0, 0], [3, 1]])
    assert checked_matches("m", rows, (4, 2)).tolist() == [[0, 0], [3, 1]]
    for bad in ([[4, 0]], [[0, -1]]):
        with pytest.raises(ChronoSceneError, match="indices into 4 and 2 keypoints"):
            checked_matches("m", np.array(bad), (4, 2))


def test_the_package_is_named_that_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "h5py", None)
    with pytest.raises(ChronoSceneError, match=r"pip install 'chronoscene\[hloc\]'"):
        HlocFile(tmp_path / "f.h5")


def test_names_that_hloc_does_not_tell_apart(tmp_path: Path) -> None:
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "m.h5", "w") as file:
        file["a-b-c.jpg/d.jpg/matches0"] = [0, -1]
    ((first, second, _),) = HlocFile(tmp_path / "m.h5").matches(["a/b-c.jpg", "d.jpg"])
    assert (first, second) == ("a/b-c.jpg", "d.jpg")
    with pytest.raises(ChronoSceneError, match=r"found a/b-c.jpg and a-b/c.jpg"):
        list(HlocFile(tmp_path / "m.h5").matches(["a/b-c.jpg", "a-b/c.jpg", "d.jpg"]))
