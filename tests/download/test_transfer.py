"""Files arrive whole, in spite of broken connections, and damage is found."""

import hashlib
from collections import namedtuple
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import pytest
from huggingface_hub.utils import are_progress_bars_disabled, enable_progress_bars

from chronoscene.download.hub import list_files, request_headers
from chronoscene.download.transfer import RemoteFile, fetch, in_words, missing_bytes
from chronoscene.errors import DiskFullError, DownloadError

CONTENT = bytes(range(256)) * 20


def no_report(what, done, total):
    pass


def files_of(hub):
    return list_files(hub.repo)[1]


def test_large_and_small_files_with_progress(hub, tmp_path):
    hub.files = {"a b/1.png": CONTENT, "ü.txt": b"small", "empty": b""}
    steps = []
    enable_progress_bars()
    fetch(files_of(hub), tmp_path / "new", report=lambda *step: steps.append(step))
    for name, content in hub.files.items():
        assert (tmp_path / "new" / name).read_bytes() == content
    assert ("MB downloaded", 0, 0) in steps and steps[-1] == ("files checked", 3, 3)
    assert are_progress_bars_disabled()  # of huggingface_hub
    assert {len(file.checksum) for file in files_of(hub)} == {40, 64}
    hub.asked.clear()
    fetch(files_of(hub), tmp_path / "new", report=no_report)
    assert not hub.asked


def test_broken_connection_goes_on_in_the_same_command(hub, tmp_path):
    hub.files, hub.breaks = {"a": CONTENT}, {"a": [3000]}
    fetch(files_of(hub), tmp_path, report=no_report)
    assert hub.asked == [("a", None), ("a", "bytes=3000-")]
    assert (tmp_path / "a").read_bytes() == CONTENT


def test_broken_command_goes_on_in_the_next_one(hub, tmp_path):
    hub.files, hub.breaks = {"a": CONTENT}, {"a": [3000] * 20}
    (file,) = files_of(hub)
    with pytest.raises(DownloadError, match="run the same command again"):
        fetch([file], tmp_path, report=no_report)
    assert missing_bytes(file, tmp_path) == len(CONTENT) - 3000
    assert not (tmp_path / "a").exists()
    hub.breaks.clear()
    hub.asked.clear()
    fetch([file], tmp_path, report=no_report)
    assert hub.asked == [("a", "bytes=3000-")]
    assert (tmp_path / "a").read_bytes() == CONTENT
    assert [path.name for path in tmp_path.iterdir()] == ["a"]


def test_another_version_of_a_file_is_not_a_continuation(hub, tmp_path):
    hub.files, hub.breaks = {"a": CONTENT}, {"a": [3000] * 20}
    with pytest.raises(DownloadError):
        fetch(files_of(hub), tmp_path, report=no_report)
    hub.files, hub.breaks = {"a": CONTENT[::-1]}, {}
    fetch(files_of(hub), tmp_path, report=no_report)
    assert (tmp_path / "a").read_bytes() == CONTENT[::-1]


def test_a_part_that_is_too_long_is_no_beginning(hub, tmp_path):
    hub.files = {"a": CONTENT}
    (file,) = files_of(hub)
    (tmp_path / f"a.{file.checksum[:8]}.part").write_bytes(CONTENT + b"?")
    fetch([file], tmp_path, report=no_report)
    assert hub.asked == [("a", None)] and (tmp_path / "a").read_bytes() == CONTENT


def test_an_error_ends_the_other_downloads(hub, tmp_path, monkeypatch):
    def end(pool, wait=True, **options):
        hub.held.set()  # goes on only now
        shutdown(pool, wait, **options)

    shutdown = ThreadPoolExecutor.shutdown
    monkeypatch.setattr(ThreadPoolExecutor, "shutdown", end)
    hub.files = {"slow": CONTENT}
    hub.held.clear()
    (slow,) = files_of(hub)
    with pytest.raises(DownloadError, match="404"):
        fetch([slow, replace(slow, path="b", url=slow.url + "b")], tmp_path, report=no_report)
    assert not (tmp_path / "slow").exists()


def test_login_and_plain_contents_are_asked_for(hub, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_TOKEN", "hf_secret")
    hub.files = {"a": CONTENT}
    fetch(files_of(hub), tmp_path, report=no_report, headers=request_headers())
    (headers,) = hub.headers
    assert headers["Authorization"] == "Bearer hf_secret"
    assert headers["Accept-Encoding"] == "identity"


def test_damaged_files_are_named_together_and_fetched_anew(hub, tmp_path):
    hub.files = {"large": CONTENT, "small": b"abc", "good": b"abd"}
    hub.damaged = {"large", "small"}
    with pytest.raises(DownloadError, match="found other contents in 'large', 'small';"):
        fetch(files_of(hub), tmp_path, report=no_report)
    assert [path.name for path in tmp_path.iterdir()] == ["good"]
    hub.damaged.clear()
    hub.asked.clear()
    fetch(files_of(hub), tmp_path, report=no_report)
    assert {name for name, _ in hub.asked} == {"large", "small"}


def test_full_disk_is_said_before(hub, tmp_path, monkeypatch):
    hub.files = {"a": CONTENT}
    disk = namedtuple("disk", "free")(1000)
    monkeypatch.setattr("chronoscene.download.transfer.shutil.disk_usage", lambda place: disk)
    with pytest.raises(DiskFullError, match=r"expected 5.1 kB of free space, found 1.0 kB"):
        fetch(files_of(hub), tmp_path, report=no_report)
    assert not hub.asked


def test_other_hosts_and_missing_files(hub, tmp_path):
    checksum = hashlib.sha256(CONTENT).hexdigest()
    file = RemoteFile("a", f"{hub.url}/elsewhere/a", len(CONTENT), checksum)
    with pytest.raises(DownloadError, match=r"expected an answer, found .*404"):
        fetch([file], tmp_path, report=no_report)


def test_conditions_that_were_not_accepted(hub, tmp_path):
    hub.files, hub.gated = {"a": CONTENT}, True
    with pytest.raises(DownloadError, match="accept them on the page of the dataset, log in"):
        fetch(files_of(hub), tmp_path, report=no_report)


@pytest.mark.parametrize(
    ("size", "text"),
    [(0, "0.0 kB"), (7289, "7.3 kB"), (553433881, "553.4 MB"), (2e12, "2,000.0 GB")],
)
def test_sizes_in_words(size, text):
    assert in_words(size) == text
