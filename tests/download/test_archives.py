"""What is unpacked stays in its folder and is a file."""

import io
import stat
import tarfile
import zipfile

import pytest

from chronoscene.download.archives import archive_stem, open_archive, unpack_scene
from chronoscene.download.catalogue import DATASETS
from chronoscene.download.datasets import find_scenes
from chronoscene.errors import DiskFullError, DownloadError


def no_report(what, done, total):
    pass


def make_zip(path, members):
    with zipfile.ZipFile(path, "w") as packed:
        for name, content in members.items():
            info = zipfile.ZipInfo(name)
            info.external_attr = (stat.S_IFREG | 0o644) << 16  # as zip programs of Unix write it
            packed.writestr(info, content)


def make_tar(path, members):
    with tarfile.open(path, "w:gz" if path.suffix != ".tar" else "w") as packed:
        for name, content in members.items():
            info = tarfile.TarInfo(name)
            info.size = len(content)
            packed.addfile(info, io.BytesIO(content))


@pytest.mark.parametrize(
    ("name", "make"),
    [("a.zip", make_zip), ("a.tar", make_tar), ("a.tar.gz", make_tar), ("a.tgz", make_tar)],
)
def test_unpacks_one_folder(tmp_path, name, make):
    make(tmp_path / name, {"x/A/sparse/split.txt": b"1", "./x/A/b": b"2", "x/AB/c": b"3"})
    with open_archive(tmp_path / name) as members:
        assert [m.size for m in members] == [1, 1, 1]
        unpack_scene(members, "x/A/", tmp_path / "out", no_report)
    files = [path for path in (tmp_path / "out").rglob("*") if path.is_file()]
    assert {str(f.relative_to(tmp_path / "out")): f.read_bytes() for f in files} == {
        "sparse/split.txt": b"1",
        "b": b"2",
    }


def test_metadata_of_macos_is_no_scene(tmp_path):
    make_zip(tmp_path / "a.zip", {"A/t0/a.jpg": b"1", "__MACOSX/A/t0/._a.jpg": b"2"})
    with open_archive(tmp_path / "a.zip") as members:
        names = [member.name for member in members]
    assert find_scenes(DATASETS["cl-splats"], names, "a") == {"A": "A/"}


@pytest.mark.parametrize("make", [make_zip, make_tar])
@pytest.mark.parametrize("name", ["../a", "/etc/a", "b/../../a", "C:/a", "..\\a"])
def test_paths_out_of_the_folder_are_refused(tmp_path, make, name):
    path = tmp_path / ("a.zip" if make is make_zip else "a.tar")
    make(path, {"good": b"", name: b"x"})
    with pytest.raises(DownloadError, match="leads out of it"), open_archive(path):
        pass


def test_links_are_refused(tmp_path):
    info = zipfile.ZipInfo("a")
    info.external_attr = (stat.S_IFLNK | 0o777) << 16
    with zipfile.ZipFile(tmp_path / "a.zip", "w") as packed:
        packed.writestr(info, "/etc/passwd")
    with tarfile.open(tmp_path / "a.tar", "w") as packed:
        for kind in (tarfile.SYMTYPE, tarfile.LNKTYPE):
            link = tarfile.TarInfo("a")
            link.type, link.linkname = kind, "../b"
            packed.addfile(link)
    for name in ("a.zip", "a.tar"):
        refused = pytest.raises(DownloadError, match="'a', which is a link or a device")
        with refused, open_archive(tmp_path / name):
            pass


@pytest.mark.parametrize("name", ["a.zip", "a.tar.gz"])
def test_damage_is_one_error_and_leaves_nothing(tmp_path, name):
    (make_zip if name.endswith("zip") else make_tar)(tmp_path / name, {"A/b": b"x" * 9999})
    content = bytearray((tmp_path / name).read_bytes())
    content[60] ^= 255  # inside of the member
    (tmp_path / name).write_bytes(content if name.endswith("zip") else content[:40])
    broken = pytest.raises(DownloadError, match="expected an archive that can be unpacked")
    with broken, open_archive(tmp_path / name) as members:
        unpack_scene(members, "A/", tmp_path / "out", no_report)
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_unpacked_size_is_compared_with_the_free_space(tmp_path, monkeypatch):
    make_zip(tmp_path / "a.zip", {"A/b": bytes(10**6)})
    monkeypatch.setattr(
        "chronoscene.download.transfer.shutil.disk_usage", lambda place: type("", (), {"free": 9})
    )
    full = pytest.raises(DiskFullError, match=r"expected 1\.0 MB of free space")
    with full, open_archive(tmp_path / "a.zip") as members:
        unpack_scene(members, "A/", tmp_path / "out", no_report)


def test_names_of_archives():
    assert [archive_stem(p) for p in ("a/B.zip", "c.tar.gz", "d.tgz", "e.7z")] == [
        "B",
        "c",
        "d",
        "",
    ]
