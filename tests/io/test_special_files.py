"""Pipes and devices in the place of files end in one error: reading them might never end."""

import os
import signal

import made_runs
import pytest

from chronoscene.errors import ChronoSceneError
from chronoscene.harness.files.records import read_run, read_with_rows
from chronoscene.harness.files.source import read_source
from chronoscene.images.decoding import image_size, load_mask, load_rgb
from chronoscene.images.exif import ExifData, read_exif
from chronoscene.io.documents import read_json_document, read_text
from chronoscene.io.staging import sha256_of
from leaderboard.entries import read_entry

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="the system has no named pipes")


@pytest.fixture(autouse=True)
def alarm():
    """Nothing here takes seconds, unless it waits for a pipe."""

    def stop(*_):
        pytest.fail("still reading")

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(10)
    yield
    signal.alarm(0)
    signal.signal(signal.SIGALRM, before)


def make(path, kind):
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")
    return path


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    "read",
    [
        *(image_size, load_rgb, lambda path: load_mask(path, (2, 2))),
        *(read_text, read_json_document, sha256_of, read_entry),
    ],
)
def test_a_file_that_is_none(tmp_path, kind, read):
    path = make(tmp_path / "a.json", kind)
    with pytest.raises((ChronoSceneError, OSError), match=r"a pipe or device|a link"):
        read(path)


def test_metadata_of_a_pipe(tmp_path):
    assert read_exif(make(tmp_path / "a.jpg", "pipe")) == ExifData()


@pytest.mark.parametrize(
    ("name", "read"),
    [("run.json", read_run), ("rows.csv", read_with_rows), ("source.json", read_source)],
)
def test_a_file_of_a_run(tmp_path, name, read):
    run = made_runs.write_scored(tmp_path)
    make(run / name, "pipe")
    with pytest.raises(ChronoSceneError, match=rf"{name}: .*a pipe or device"):
        read(run)
