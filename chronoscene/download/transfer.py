"""Files from a host: fetched side by side, resumed where they were cut off, checked at the end."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from io import BufferedWriter, FileIO
from pathlib import Path
from typing import Any

from chronoscene.errors import DiskFullError, DownloadError
from chronoscene.io.processes import Report
from chronoscene.io.staging import disk_full, needing_space, sha256_of
from chronoscene.io.wording import in_words, shown

WORKERS = 8
"""Files at a time: of a photo, waiting for the host takes longer than the transfer."""
SHA256_DIGITS = 64
AGAIN = "run the same command again, which goes on where this one stopped"
NAMED = 20  # Damaged files that the message names


@dataclass(frozen=True, slots=True)
class RemoteFile:
    """A file on a host, and how to know that it has arrived as it is there."""

    path: str
    """Path below the folder that it goes to, with slashes."""
    url: str
    size: int
    """Bytes."""
    checksum: str
    """SHA-256 of the content (64 digits), or the id that git gives it (40 digits)."""


def fetch(
    files: Sequence[RemoteFile],
    folder: Path,
    *,
    report: Report,
    headers: Mapping[str, str] | None = None,
) -> None:
    """Bring files into a folder and compare all of them with their checksums.

    Files that are there with the right size are not fetched again. What was fetched of a file
    before something went wrong is kept beside its place, with the ending ``.part``.

    Args:
        files: What to fetch.
        folder: Created where it does not exist.
        report: Called with megabytes, then with files that were checked, from any thread.
        headers: Of the requests.

    Raises:
        DownloadError: If a file cannot be had, or arrived damaged; damaged files are deleted.
        DiskFullError: If the files do not fit on the disk.
    """
    from huggingface_hub.utils import disable_progress_bars

    disable_progress_bars()  # one for each file
    folder.mkdir(parents=True, exist_ok=True)
    check_space(folder, sum(missing_bytes(file, folder) for file in files))
    meter = _Meter(sum(file.size for file in files), report)
    with needing_space(folder), ThreadPoolExecutor(WORKERS) as pool:
        running = [pool.submit(_fetch, file, folder, headers or {}, meter) for file in files]
        try:
            for future in as_completed(running):
                future.result()
        except BaseException:
            meter.stopped = True
            pool.shutdown(cancel_futures=True)
            raise
    _check(files, folder, report)


def missing_bytes(file: RemoteFile, folder: Path) -> int:
    """Return the number of bytes of a file that are still to be fetched."""
    whole, part = folder / file.path, _part(file, folder)
    there = next((path.stat().st_size for path in (whole, part) if path.is_file()), 0)
    return max(file.size - there, 0)


def check_space(folder: Path, needed: int) -> None:
    """Refuse to begin what the disk has no space for.

    Args:
        folder: An existing folder on the disk.
        needed: Bytes.

    Raises:
        DiskFullError: If there is less.
    """
    free = shutil.disk_usage(folder).free
    if free < needed:
        raise DiskFullError(
            folder,
            expected=f"{in_words(needed)} of free space",
            found=in_words(free),
            todo="free space on this disk, choose a place on another one, or name fewer scenes",
        )


@contextmanager
def answering(place: object) -> Iterator[None]:
    """Turn what goes wrong between this machine and a host into one message.

    Raises:
        DownloadError: Instead of the errors of huggingface_hub and of the library below it.
        DiskFullError: If the disk is full.
    """
    from huggingface_hub.errors import GatedRepoError, HTTPError

    try:
        yield
    except GatedRepoError as error:
        raise DownloadError(
            place,
            expected="a login that may read this dataset",
            found="conditions that have to be accepted",
            todo="accept them on the page of the dataset, log in with hf auth login or set "
            "HF_TOKEN, and run the command again",
        ) from error
    except (HTTPError, OSError, ValueError) as error:
        if isinstance(error, OSError) and (full := disk_full(error, place)) is not None:
            raise full from error
        found = " ".join(str(error).split()) or type(error).__name__
        raise DownloadError(place, expected="an answer", found=found, todo=AGAIN) from error


class _Meter:
    """Counts what arrives in all threads."""

    def __init__(self, total: int, report: Report) -> None:
        self.done, self.total, self.stopped = 0, total, False
        self._report, self._lock = report, threading.Lock()
        self.add(0)

    def add(self, size: int) -> None:
        if self.stopped:
            raise CancelledError
        with self._lock:
            self.done += size
            self._report("MB downloaded", self.done // 10**6, self.total // 10**6)


class _Metered(BufferedWriter):
    """A file that is written on at its end."""

    def __init__(self, path: Path, meter: _Meter) -> None:
        super().__init__(FileIO(path, "ab"))
        self._meter = meter
        meter.add(self.tell())

    def write(self, data: Any) -> int:
        self._meter.add(len(data))
        return super().write(data)


def _part(file: RemoteFile, folder: Path) -> Path:
    """Path of a file until it is complete; files of other contents do not continue each other."""
    whole = folder / file.path
    return whole.with_name(f"{whole.name}.{file.checksum[:8]}.part")


def _fetch(file: RemoteFile, folder: Path, headers: Mapping[str, str], meter: _Meter) -> None:
    # hf_hub_download begins a file anew when the command before was ended: that would lose an
    # archive of a whole dataset. This function below it goes on at any size, and tries again by
    # itself when the connection breaks.
    from huggingface_hub.file_download import http_get

    whole, part = folder / file.path, _part(file, folder)
    if whole.is_file() and whole.stat().st_size == file.size:
        meter.add(file.size)
        return
    whole.parent.mkdir(parents=True, exist_ok=True)
    if part.is_file() and part.stat().st_size > file.size:
        part.unlink()
    with _Metered(part, meter) as out, answering(file.url):
        http_get(
            file.url,
            out,
            resume_size=out.tell(),
            # The sizes are those of what is stored, not of what is compressed on the way.
            headers={**headers, "Accept-Encoding": "identity"},
            expected_size=file.size,
        )
    part.replace(whole)


def _check(files: Sequence[RemoteFile], folder: Path, report: Report) -> None:
    """Compare files with their checksums and delete those that differ."""
    damaged = []
    for done, file in enumerate(files, start=1):
        path = folder / file.path
        if _checksum(path, len(file.checksum)) != file.checksum:
            path.unlink()
            damaged.append(file.path)
        report("files checked", done, len(files))
    if damaged:
        raise DownloadError(
            folder,
            expected="files with the checksums of the host",
            found=f"other contents in {shown(damaged, NAMED)}",
            todo="run the same command again, which fetches these files anew",
        )


def _checksum(path: Path, digits: int) -> str:
    from huggingface_hub.utils.sha import git_hash

    return sha256_of(path) if digits == SHA256_DIGITS else git_hash(path.read_bytes())
