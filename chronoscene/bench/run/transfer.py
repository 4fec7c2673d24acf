"""Files and folders on their way to another machine and back, in pieces."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator
from pathlib import Path

from chronoscene.errors import CheckpointError
from chronoscene.io.staging import leads_out, needing_space, sha256_of

PIECE = 8 * 2**20  # Bytes of a file that travel at a time


def content_hash(place: Path) -> str:
    """SHA-256 over the names and contents of all files of a folder, or over one file."""
    contents = {name: sha256_of(path) for name, path in _files(place).items()}
    return hashlib.sha256(json.dumps(contents).encode()).hexdigest()


def _files(place: Path) -> dict[str, Path]:
    """All files of a folder by their names with slashes, sorted; a file itself is ``.``."""
    if place.is_file():
        return {".": place}
    found = [
        Path(folder, name)
        for folder, _, names in os.walk(place, followlinks=True)
        for name in names
    ]
    return {path.relative_to(place).as_posix(): path for path in sorted(found)}


def read_pieces(place: Path) -> Iterator[tuple[str, bytes]]:
    """The files of a place, each as its name with one piece after the other."""
    for name, path in _files(place).items():
        with path.open("rb") as file:
            yield name, file.read(PIECE)  # of an empty file, too
            while data := file.read(PIECE):
                yield name, data


def write_piece(place: Path, name: str, data: bytes) -> None:
    """Append a piece that `read_pieces` gave to its file below another place.

    Raises:
        CheckpointError: If its name leads out of the place.
        DiskFullError: If there is no space for it.
    """
    if name != "." and leads_out(name):
        raise CheckpointError(
            repr(name),
            expected="the name of a file of the run",
            found="a path that leads outside",
            todo="do not use that machine",
        )
    target = place / name
    with needing_space(place):
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("ab") as file:
            file.write(data)


def check_arrived(place: Path, digest: str) -> None:
    """Check that a place has the content of what was sent.

    Raises:
        CheckpointError: If it has another one.
    """
    if content_hash(place) != digest:
        raise CheckpointError(
            place, expected="the files that were sent", found="others", todo="run the command again"
        )


def find_copy(place: Path, digest: str, copies: Path) -> Path | None:
    """What has that content on this machine: a copy, or the same place; None if nothing."""
    copy = copies / digest / place.name
    if copy.exists():
        return copy
    return place if place.exists() and content_hash(place) == digest else None


def keep_copy(arrived: Path, digest: str, copies: Path, name: str) -> Path:
    """Check what has arrived and keep it in the folder of copies under its name.

    Raises:
        CheckpointError: If it is not what was sent.
    """
    check_arrived(arrived, digest)
    copy = copies / digest / name
    copy.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.replace(arrived, copy)
    except OSError:
        if not copy.exists():  # else another run was faster
            raise
    return copy
