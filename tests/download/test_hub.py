"""Lists of files from the hub."""

import pytest
from hub_standin import COMMIT

from chronoscene.download.hub import list_files
from chronoscene.errors import DownloadError


def test_lists_files_with_checksums_of_their_contents(hub):
    hub.files = {"small": b"hello\n", "large": b"x" * 3000}
    commit, (small, large) = list_files(hub.repo)
    assert commit == COMMIT
    assert small.checksum == "ce013625030ba8dba906f756967f9e9ca394464a"  # git hash-object
    assert (small.size, len(large.checksum)) == (6, 64)
    assert small.url == f"{hub.url}/datasets/{hub.repo}/resolve/{COMMIT}/small"


def test_unknown_dataset_and_silent_host(hub, monkeypatch):
    with pytest.raises(DownloadError, match=r"datasets/no/such: expected an answer, found .*404"):
        list_files("no/such")
    monkeypatch.setenv("HF_ENDPOINT", "http://127.0.0.1:9")
    with pytest.raises(DownloadError, match=r"127.0.0.1:9.*expected an answer, found .*refused"):
        list_files(hub.repo)


def test_paths_stay_in_the_folder(hub):
    hub.files = {"../a": b""}
    with pytest.raises(DownloadError, match=r"found '\.\./a'"):
        list_files(hub.repo)
