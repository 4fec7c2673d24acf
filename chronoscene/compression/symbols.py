"""Numbers and symbols one after the other: numbers as they are, symbols by their frequencies.

Symbols are coded by ANS (Duda 2009) as the package ``constriction`` has it, each sequence with a
table of its values and how often each occurs.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.checks import import_extra
from chronoscene.errors import CheckpointError

MAX_TABLE = 2**23
"""Values of a sequence; ``constriction`` has frequencies of 24 bits."""


def _constriction() -> Any:
    return import_extra("constriction", "compress", "coded models")


def _model(counts: NDArray[np.int64]) -> Any:
    probabilities = counts / counts.sum()
    return _constriction().stream.model.Categorical(probabilities, perfect=False)


class Writer:
    """Collects what `Reader` reads."""

    def __init__(self) -> None:
        self.raw = bytearray()
        """Numbers, and the tables of the symbols."""
        self._sequences: list[tuple[NDArray[np.int32], NDArray[np.int64]]] = []

    def numbers(self, values: ArrayLike, kind: str) -> None:
        """Write numbers of a NumPy type, little-endian."""
        self.raw += np.ascontiguousarray(values, f"<{kind}").tobytes()

    def symbols(self, values: NDArray[np.int64]) -> None:
        """Write integers of 32 bits, of which there is at least one."""
        table, places, counts = np.unique(values, return_inverse=True, return_counts=True)
        self.numbers([len(table)], "u4")
        self.numbers(np.diff(table, prepend=0), "i4")
        self.numbers(counts, "u4")
        if len(table) > 1:
            self._sequences.append((places.astype(np.int32), counts))

    def words(self) -> bytes:
        """All symbols, coded."""
        if not self._sequences:
            return b""
        coder = _constriction().stream.stack.AnsCoder()
        for places, counts in reversed(self._sequences):
            coder.encode_reverse(places, _model(counts))
        return np.asarray(coder.get_compressed(), "<u4").tobytes()


class Reader:
    """Reads what a `Writer` collected, in the same order; trusts nothing."""

    def __init__(self, place: object, raw: bytes, words: bytes) -> None:
        self._place, self._raw, self._at = place, raw, 0
        self.check(len(words) % 4 == 0 and words[-4:] != bytes(4), "the end of the symbols")
        self._coder: Any = None
        if words:
            coded = np.frombuffer(words, "<u4").astype(np.uint32)
            self._coder = _constriction().stream.stack.AnsCoder(coded)

    def check(self, holds: Any, what: str) -> None:
        """Refuse the file unless something holds."""
        if not holds:
            raise CheckpointError(
                self._place,
                expected="a compressed model",
                found=f"something else in {what}",
                todo="the file is damaged: copy it again, or compress the run again",
            )

    def numbers(self, count: int, kind: str) -> NDArray[Any]:
        """The next numbers."""
        size = count * np.dtype(kind).itemsize
        self.check(size <= len(self._raw) - self._at, "its length")
        self._at += size
        return np.frombuffer(self._raw, f"<{kind}", count, self._at - size)

    def symbols(self, count: int) -> NDArray[np.int64]:
        """The next sequence of symbols."""
        (size,) = map(int, self.numbers(1, "u4"))
        self.check(0 < size <= min(count, MAX_TABLE), "a table of symbols")
        table = np.cumsum(self.numbers(size, "i4"), dtype=np.int64)
        counts = self.numbers(size, "u4").astype(np.int64)
        holds = (np.diff(table) > 0).all() and counts.min() > 0 and counts.sum() == count
        self.check(holds, "a table of symbols")
        if size == 1:
            return np.repeat(table, count)
        self.check(self._coder is not None, "the symbols")
        return table[self._coder.decode(_model(counts), count)]

    def close(self) -> None:
        """Check that nothing is left."""
        done = self._coder is None or self._coder.is_empty()
        self.check(done and self._at == len(self._raw), "its length")
