"""Taking records out of a binary file that may end anywhere, with messages that say where."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from chronoscene.errors import SceneError

T = TypeVar("T")

COUNT = struct.Struct("<Q")
"""The number of records, or of parts of one."""


class RecordError(Exception):
    """What is wrong inside a file, in words."""


class RecordReader:
    """Takes one thing after the other out of a file, and says which record the file ends inside."""

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.at = 0
        """Bytes taken so far."""
        self.index: int | None = None
        """Of the record that is being read; None while their number is read."""
        self.kind = ""
        self.parts = ""
        """Parts that the record announces, in words. Forgotten at the next record."""

    def records(self, kind: str, smallest: int) -> Iterator[int]:
        """Index of each record; the walk takes its parts before it asks for the next.

        Raises:
            RecordError: If so many records of at least ``smallest`` bytes cannot fit into the
                file, or something follows the last.
        """
        (count,) = self.unpack(COUNT)
        if count * smallest > len(self.data) - self.at:
            raise RecordError(f"{count} records announced in {len(self.data)} bytes")
        self.kind = kind
        for self.index in range(count):
            self.parts = ""
            yield self.index
        if self.at != len(self.data):
            raise RecordError(f"{len(self.data) - self.at} bytes after the last record")

    def unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        """The next values of a layout."""
        return layout.unpack_from(self.data, self.skip(layout.size))

    def skip(self, size: int) -> int:
        """Go on by ``size`` bytes, which must be there; returns where they begin."""
        begin = self.at
        if size > len(self.data) - begin:
            raise self.ends()
        self.at += size
        return begin

    def text(self) -> bytes:
        """The next bytes up to a zero byte, which is taken too."""
        begin, end = self.at, self.data.find(b"\0", self.at)
        if end < 0:
            raise self.ends()
        self.at = end + 1
        return self.data[begin:end]

    def ends(self) -> RecordError:
        """The complaint that the file ends too early."""
        if self.index is None:
            return RecordError("a file that ends inside the number of its records")
        announced = f", which announces {self.parts}" if self.parts else ""
        return RecordError(f"a file that ends inside {self.kind} record {self.index}{announced}")


def read_records(path: Path, walk: Callable[[RecordReader], T]) -> T:
    """What a walk makes of the records of a file.

    Raises:
        SceneError: If the file cannot be read, or the walk raises RecordError.
    """
    try:
        return walk(RecordReader(path.read_bytes()))
    except OSError as error:
        found = error.strerror or "unreadable"
    except RecordError as error:
        found = str(error)
    raise SceneError(
        path,
        expected="complete COLMAP records",
        found=found,
        todo="copy the file again or write the model again with COLMAP",
    )
