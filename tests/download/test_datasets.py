"""Scenes of every layout that a dataset may have on the hub."""

import io
import json
import zipfile
from collections import namedtuple
from pathlib import Path

import pytest
from hub_standin import COMMIT

from chronoscene.download.catalogue import DATASETS
from chronoscene.download.datasets import download_scenes
from chronoscene.errors import ConfigError, DiskFullError, DownloadError

CHRONOSCENE = DATASETS["chronoscene"]


def scene_files(folder, number=0):
    return {
        f"{folder}sparse/split.txt": b"a.png 0\n",
        f"{folder}sparse/0/points3D.bin": bytes([number]) * 3000,
        f"{folder}images/a.png": bytes([number]) * 500,
    }


def packed(files):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in files.items():
            archive.writestr(name, content)
    return file.getvalue()


def download(out, *scenes):
    said = []
    download_scenes(CHRONOSCENE, out, scenes, report=lambda *step: None, log=said.append)
    return said


def tree(folder):
    files = [path for path in Path(folder).rglob("*") if path.is_file()]
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


FOLDERS = {"README.md": b"", **scene_files("real/A/", 1), **scene_files("B/", 2)}
ONE_EACH = {"x/A.zip": packed(scene_files("A/", 1)), "B.zip": packed(scene_files("", 2))}
ONE_FOR_ALL = {"All.zip": packed({**scene_files("All/A/", 1), **scene_files("All/B/", 2)})}
LAYOUTS = pytest.mark.parametrize(
    "files", [FOLDERS, ONE_EACH, ONE_FOR_ALL], ids=["folders", "archives", "archive"]
)


@LAYOUTS
def test_all_scenes_of_every_layout(hub, tmp_path, files):
    hub.files = files
    said = download(tmp_path / "out")
    record = json.loads((tmp_path / "out/download.json").read_text())
    (tmp_path / "out/download.json").unlink()
    assert tree(tmp_path / "out") == {**scene_files("A/", 1), **scene_files("B/", 2)}
    assert record["scenes"] == {"A": COMMIT, "B": COMMIT}
    assert said[0].startswith("ChronoScene: ") and said[0].endswith(("download", "unpack"))


@LAYOUTS
def test_one_scene_then_the_other_then_nothing(hub, tmp_path, files):
    hub.files = files
    download(tmp_path, "A")
    assert (tmp_path / "A").is_dir() and not (tmp_path / "B").exists()
    (tmp_path / "A/mine").write_text("left alone")
    download(tmp_path)
    assert (tmp_path / "B/images/a.png").is_file() and (tmp_path / "A/mine").is_file()
    hub.asked.clear()
    assert download(tmp_path) == [f"ChronoScene: all of it is in {tmp_path}"]
    assert download(tmp_path, "B") == [f"ChronoScene: all of it is in {tmp_path}"]
    assert not hub.asked and not (tmp_path / ".download").exists()


def test_size_is_said_without_what_is_there(hub, tmp_path):
    hub.files, hub.breaks = FOLDERS, {"B/sparse/0/points3D.bin": [2000] * 20}
    with pytest.raises(DownloadError):
        download(tmp_path, "B")
    assert not (tmp_path / "B").exists()
    hub.breaks.clear()
    hub.asked.clear()
    (said,) = download(tmp_path, "B")
    assert said.startswith("ChronoScene: 1.") and said.endswith("kB in 3 files to download")
    assert ("B/sparse/0/points3D.bin", "bytes=2000-") in hub.asked
    assert tree(tmp_path / "B") == scene_files("", 2)


@LAYOUTS
def test_unknown_scenes_are_answered_with_the_names(hub, tmp_path, files):
    hub.files = files
    with pytest.raises(ConfigError, match=r"names of scenes: 'A', .*'B', found 'C', 'a';"):
        download(tmp_path, "A", "a", "C")
    hub.asked.clear()
    download(tmp_path, "A", "B")
    assert (tmp_path / "A").is_dir() and (tmp_path / "B").is_dir()
    assert not any(path == "All.zip" for path, _ in hub.asked)
    assert not (tmp_path / ".download").exists()


def test_space_for_what_is_unpacked_is_asked_for_before(hub, tmp_path, monkeypatch):
    hub.files = dict(ONE_FOR_ALL)
    (size,) = map(len, hub.files.values())
    disk = namedtuple("disk", "free")(2 * size - 1)
    monkeypatch.setattr("chronoscene.download.transfer.shutil.disk_usage", lambda place: disk)
    with pytest.raises(DiskFullError, match="of free space"):
        download(tmp_path)
    assert not hub.asked


def test_archive_beside_folders_is_fetched_only_by_its_name(hub, tmp_path):
    hub.files = {**FOLDERS, "Extra.zip": packed(scene_files("C/", 3))}
    download(tmp_path)
    assert not (tmp_path / "C").exists()
    download(tmp_path, "Extra")
    assert tree(tmp_path / "C") == scene_files("", 3)


def test_files_of_an_older_version_do_not_stay(hub, tmp_path):
    hub.files = {**scene_files("A/", 1), "A/images/old.png": b"old"}
    hub.damaged = {"A/images/a.png"}
    with pytest.raises(DownloadError, match=r"other contents in 'A/images/a\.png'"):
        download(tmp_path)
    hub.damaged.clear()
    del hub.files["A/images/old.png"]
    download(tmp_path)
    assert tree(tmp_path / "A") == scene_files("", 1)


def test_downloads_of_other_scenes_are_kept(hub, tmp_path):
    hub.files, hub.damaged = dict(FOLDERS), {"B/images/a.png"}
    with pytest.raises(DownloadError):
        download(tmp_path)
    download(tmp_path, "A")
    hub.damaged.clear()
    hub.asked.clear()
    download(tmp_path)
    assert hub.asked == [("B/images/a.png", None)]


def test_damaged_record_counts_as_none(hub, tmp_path):
    hub.files = dict(ONE_EACH)
    (tmp_path / "download.json").write_text('{"scenes": 1}')
    download(tmp_path, "A")
    assert json.loads((tmp_path / "download.json").read_text())["scenes"] == {"A": COMMIT}


@pytest.mark.parametrize(
    ("files", "message"),
    [
        (
            {"README.md": b""},
            r"folders of scenes, or archives .* found 'README.md'; get the dataset by hand",
        ),
        ({"a.zip": packed({"b": b""})}, "a.zip: expected a scene, .* found 'b'; get the"),
        ({}, "found no files; get"),
    ],
)
def test_layouts_without_scenes(hub, tmp_path, files, message):
    hub.files = files
    with pytest.raises(DownloadError, match=message):
        download(tmp_path)
