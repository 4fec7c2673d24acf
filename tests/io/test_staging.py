"""Files appear complete or not at all."""

import errno
import os
import re
from concurrent.futures import ThreadPoolExecutor

import pytest

from chronoscene.errors import ConfigError, DiskFullError, SceneError
from chronoscene.io import staging
from chronoscene.io.staging import (
    check_outside,
    leads_out,
    needing_space,
    partial_name,
    remove_abandoned,
    replacing,
    staged_folder,
    write_text_atomic,
)

FULL = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # writes of a file do not name it


def test_text_is_utf8_with_plain_line_ends(tmp_path):
    path = tmp_path / "a.txt"
    write_text_atomic(path, "früher\nspäter\n")
    assert path.read_bytes() == "früher\nspäter\n".encode()
    write_text_atomic(path, "new\n")
    assert path.read_bytes() == b"new\n"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_a_block_that_fails_leaves_the_old_file_alone(tmp_path, error):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(error), replacing(path) as partial:
        partial.write_text("half")
        assert path.read_text() == "old"
        raise error
    assert path.read_text() == "old"
    assert list(tmp_path.iterdir()) == [path]


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")
def test_a_pipe_stays_and_gets_the_content(tmp_path, monkeypatch):
    streams, folder = tmp_path / "dev", tmp_path / "run"
    streams.mkdir()
    folder.mkdir()
    pipe = streams / "pipe"
    os.mkfifo(pipe)
    monkeypatch.setattr(staging, "STREAMS", (str(streams),))
    for link in (streams / "stdout", folder / "rows.csv"):
        link.symlink_to(pipe)
    for path in (pipe, streams / "stdout"):
        with ThreadPoolExecutor() as pool:
            read = pool.submit(pipe.read_bytes)
            write_text_atomic(path, "text\n")
        assert read.result(timeout=10) == b"text\n"
    with pytest.raises(ValueError), replacing(pipe):
        raise ValueError
    # A link that came with a folder, on the other hand, is replaced and not followed.
    write_text_atomic(folder / "rows.csv", "text\n")
    assert not (folder / "rows.csv").is_symlink()
    assert sorted(p.name for p in streams.iterdir()) == ["pipe", "stdout"]
    assert pipe.is_fifo()


def test_a_file_that_cannot_be_put_in_place_leaves_nothing(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(OSError):
        write_text_atomic(tmp_path / "folder", "text")
    assert [p.name for p in tmp_path.iterdir()] == ["folder"]
    with pytest.raises(FileNotFoundError):
        write_text_atomic(tmp_path / "absent" / "a.txt", "text")


@pytest.mark.parametrize("link", ["images", "images/2016"])
def test_what_a_scene_links_to_is_inside_of_it(tmp_path, link):
    scene, photos = tmp_path / "scene", tmp_path / "photos"
    photos.mkdir()
    (scene / link).parent.mkdir(parents=True)
    (scene / link).symlink_to(photos)
    (scene / "up").symlink_to(tmp_path)
    check_outside(tmp_path / "out", [scene])
    for place in (scene, scene / "out", photos, photos / "new" / "out"):
        with pytest.raises(ConfigError, match="expected a place outside the scene, found one in"):
            check_outside(place, [scene])


def test_a_full_disk_is_told_with_the_name_of_the_file(tmp_path):
    path = tmp_path / "a.txt"
    message = f"{path}: expected space for what is written there, found No space left on device;"
    with pytest.raises(DiskFullError, match=re.escape(message)), replacing(path) as partial:
        partial.write_text("half")
        raise FULL
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_told_with_the_name_of_the_folder(tmp_path):
    out = tmp_path / "out"
    with pytest.raises(DiskFullError) as caught, staged_folder(out) as staged:
        (staged / "half").touch()
        with replacing(staged / "a.txt"):
            raise FULL
    assert caught.value.place == str(out)
    assert list(tmp_path.iterdir()) == []


def test_a_block_that_fails_leaves_no_folder(tmp_path):
    (tmp_path / "there").mkdir()
    with pytest.raises(ValueError), staged_folder(tmp_path / "there/a/b/out"):
        raise ValueError
    assert [*tmp_path.rglob("*")] == [tmp_path / "there"]
    with staged_folder(tmp_path / "there/a/b/out") as staged:
        (staged / "file").touch()
    assert (tmp_path / "there/a/b/out/file").is_file()


def test_other_errors_of_the_system_are_no_full_disks(tmp_path):
    with pytest.raises(PermissionError), needing_space(tmp_path):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))
    with pytest.raises(SceneError, match="Permission denied"), staged_folder(tmp_path / "out"):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES))


def test_only_what_ended_processes_of_this_machine_left_is_removed(tmp_path):
    own = tmp_path / partial_name("seed0")
    _, name, machine, boot, pid, ending = own.name.split(".")

    def leave(name=name, machine=machine, boot=boot, pid=2**22 + 1):
        folder = tmp_path / f".{name}.{machine}.{boot}.{pid}.{ending}"
        (folder / "checkpoint").mkdir(parents=True)
        return folder

    gone = [leave(), leave(boot="0ld", pid=os.getppid()), leave(pid=pid)]
    kept = [leave(machine="another"), leave(pid=os.getppid()), leave(name="seed1")]
    (tmp_path / gone[0].name.replace("seed0", "seed0.json")).touch()
    remove_abandoned(tmp_path, "seed0*")
    assert sorted(tmp_path.iterdir()) == sorted(kept)
    assert own in gone


@pytest.mark.parametrize("host", ["node-1.cluster.example", "a" * 63])
def test_machines_have_short_names_without_dots(monkeypatch, host):
    monkeypatch.setattr(staging.socket, "gethostname", lambda: host)
    name = staging._machine.__wrapped__()
    assert len(name) <= 32 and "." not in name and name != "a" * 32


@pytest.mark.parametrize(
    ("name", "out"),
    [("a/b", False), ("./a", False), ("a/../b", True), ("/a", True), ("", True), ("C:a", True)],
)
def test_leads_out(name, out):
    assert leads_out(name) == out
