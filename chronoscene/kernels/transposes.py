"""Loads and stores that turn rows in memory into columns in vectors, and back.

A matrix in memory has a row for each lane; in a kernel each of its columns is a vector. Arrays are
flat and contiguous; offsets count numbers and are not checked.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from chronoscene.kernels.compilation import FAST_MATH
from chronoscene.kernels.memory import emit_address, emit_load, emit_store
from chronoscene.kernels.vectors import Vector, emit_shuffle, emitted


class _Rows:
    """Vectors at distances from a place in memory, while code is generated."""

    def __init__(self, context: Any, builder: Any, sig: Any, args: Any) -> None:
        self.builder, self.index = builder, args[1].type
        self.start = emit_address(context, builder, sig.args[0], *args[:2])

    def load(self, distance: Any, lanes: int) -> Any:
        return emit_load(self.builder, self._at(distance), lanes)

    def store(self, distance: Any, value: Any) -> None:
        emit_store(self.builder, value, self._at(distance))

    def in_row(self, row: int, stride: Any, column: int) -> Any:
        """Distance of a number in a matrix whose rows are ``stride`` numbers apart."""
        return self.builder.add(self.builder.mul(stride, self.index(row)), self.index(column))

    def _at(self, distance: Any) -> Any:
        number = self.index(distance) if isinstance(distance, int) else distance
        return self.builder.gep(self.start, [number])


def _emit_pick(builder: Any, sources: list[Any], lanes: list[tuple[int, int]]) -> Any:
    """Vector of (source, lane) pairs taken from any number of vectors of one width."""
    width, n = sources[0].type.count, len(lanes)
    result, placed = None, set[int]()
    for first in range(0, len(sources), 2):
        pair = [sources[first], sources[min(first + 1, len(sources) - 1)]]
        here = {i for i, (source, _) in enumerate(lanes) if source - first in (0, 1)}
        if not here:
            continue
        wanted = [
            (source - first) * width + lane if i in here else None
            for i, (source, lane) in enumerate(lanes)
        ]
        piece = emit_shuffle(builder, pair[0], pair[1], wanted)
        if result is None:
            result = piece
        else:
            merged = [n + i if i in here else i if i in placed else None for i in range(n)]
            result = emit_shuffle(builder, result, piece, merged)
        placed |= here
    return result


def make_load_columns(count: int, lanes: int) -> Callable:
    """Make a function that reads the columns of a matrix that has this many."""

    @emitted(lambda array, offset: _vectors(count, lanes)(array, types.intp))
    def load_columns(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Columns of ``lanes`` consecutive rows of a matrix, one vector each."""
        memory = _Rows(context, builder, sig, args)
        parts = [memory.load(i * lanes, lanes) for i in range(count)]
        columns = []
        for c in range(count):
            flat = [count * i + c for i in range(lanes)]
            columns.append(_emit_pick(builder, parts, [divmod(k, lanes) for k in flat]))
        return context.make_tuple(builder, sig.return_type, columns)

    return load_columns


def _vectors(count: int, lanes: int) -> Any:
    """Type of a tuple of vectors."""
    return types.UniTuple(Vector("f32", lanes), count)


def _pieces(count: int, lanes: int) -> list[int]:
    """First columns of the vectors that hold ``count`` columns; the last ones may overlap."""
    return [min(first, max(count - lanes, 0)) for first in range(0, count, lanes)]


def make_load_some_columns(count: int, lanes: int) -> Callable:
    """Make a function that reads this many columns of a matrix with at least as many."""

    @emitted(lambda array, offset, stride: _vectors(count, lanes)(array, types.intp, types.intp))
    def load_some_columns(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Columns of ``lanes`` rows, ``stride`` numbers apart, one vector each.

        Reads whole vectors of a row, of which the first begins at the offset.
        """
        memory = _Rows(context, builder, sig, args)
        columns: dict[int, Any] = {}
        for first in _pieces(count, lanes):
            rows = [memory.load(memory.in_row(i, args[2], first), lanes) for i in range(lanes)]
            columns |= enumerate(_emit_transpose(builder, rows), first)
        return context.make_tuple(builder, sig.return_type, [columns[c] for c in range(count)])

    return load_some_columns


@emitted(lambda array, offset, stride, columns: types.void(array, types.intp, types.intp, columns))
def store_some_columns(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Write vectors, at least as many as lanes, as columns of rows ``stride`` numbers apart."""
    count, lanes = len(sig.args[3]), sig.args[3][0].lanes
    memory = _Rows(context, builder, sig, args)
    columns = cgutils.unpack_tuple(builder, args[3], count)
    for first in _pieces(count, lanes):
        rows = _emit_transpose(builder, columns[first : first + lanes])
        for i, row in enumerate(rows):
            memory.store(memory.in_row(i, args[2], first), row)


@emitted(lambda array, offset, columns: types.void(array, types.intp, columns))
def store_columns(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Write vectors as the columns of consecutive rows of a matrix."""
    count, lanes = len(sig.args[2]), sig.args[2][0].lanes
    memory = _Rows(context, builder, sig, args)
    vectors = cgutils.unpack_tuple(builder, args[2], count)
    for i in range(count):
        flat = range(i * lanes, (i + 1) * lanes)
        row = _emit_pick(builder, vectors, [(k % count, k // count) for k in flat])
        memory.store(i * lanes, row)


def _emit_transpose(builder: Any, vectors: list[Any]) -> list[Any]:
    """Rows from columns, by log2(n) rounds of interleaving the two halves of the list."""
    n = len(vectors)
    low: list[int | None] = [i // 2 + (i % 2) * n for i in range(n)]
    high: list[int | None] = [n // 2 + i // 2 + (i % 2) * n for i in range(n)]
    for _ in range(n.bit_length() - 1):
        halves = list(zip(vectors[: n // 2], vectors[n // 2 :], strict=True))
        vectors = [emit_shuffle(builder, a, b, lanes) for a, b in halves for lanes in (low, high)]
    return vectors


@emitted(lambda array, offset, fields: types.void(array, types.intp, fields))
def store_records(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Write 16 vectors as records of 16 numbers."""
    lanes = sig.args[2][0].lanes
    memory = _Rows(context, builder, sig, args)
    vectors = cgutils.unpack_tuple(builder, args[2], 16)
    for part in range(0, 16, lanes):
        for i, row in enumerate(_emit_transpose(builder, vectors[part : part + lanes])):
            memory.store(16 * i + part, row)


def make_load_records(lanes: int) -> Callable:
    """Make a function that reads the 16 fields of as many records as a vector has lanes."""

    @emitted(lambda array, offset: _vectors(16, lanes)(array, types.intp))
    def load_records(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """The 16 fields of ``lanes`` records of 16 numbers, one vector each."""
        memory = _Rows(context, builder, sig, args)
        fields = []
        for part in range(0, 16, lanes):
            rows = [memory.load(16 * i + part, lanes) for i in range(lanes)]
            fields += _emit_transpose(builder, rows)
        return context.make_tuple(builder, sig.return_type, fields)

    return load_records


def _emit_sums(builder: Any, vectors: list[Any]) -> Any:
    """Vector whose lane i is the sum of the lanes of vector i; None counts as zeros.

    Rounds of adding halves of pairs of vectors, first within groups of four lanes, where shuffles
    are cheap, then across: the order of summation is fixed.
    """
    lanes = next(v for v in vectors if v is not None).type.count
    groups = lanes // 4
    inner = [
        ([0, lanes, 1, lanes + 1], [2, lanes + 2, 3, lanes + 3]),
        ([0, 1, lanes, lanes + 1], [2, 3, lanes + 2, lanes + 3]),
    ]
    rounds = [
        tuple([4 * g + i for g in range(groups) for i in half] for half in halves)
        for halves in inner
    ]
    while groups > 1:
        # Two vectors with `groups` groups of sums each are folded into one.
        both = list(range(0, lanes // 4, 2)), list(range(1, lanes // 4, 2))
        rounds.append(
            tuple(
                [4 * g + i + part * lanes for part in (0, 1) for g in half for i in range(4)]
                for half in both
            )
        )
        groups //= 2
    for low, high in rounds:
        folded: list[Any] = []
        for a, b in zip(vectors[0::2], vectors[1::2], strict=True):
            if a is None and b is None:
                folded.append(None)
                continue
            zeros = ir.Constant((a or b).type, None)
            x, y = (zeros if v is None else v for v in (a, b))
            halves = [emit_shuffle(builder, x, y, half) for half in (low, high)]
            folded.append(builder.fadd(*halves, flags=FAST_MATH))
        vectors = folded
    return vectors


@emitted(lambda array, offset, vectors: types.void(array, types.intp, vectors))
def store_sums(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Write the sum over the lanes of each vector as one row of 16 numbers; the rest is 0."""
    count, kind = len(sig.args[2]), sig.args[2][0]
    memory = _Rows(context, builder, sig, args)
    given = cgutils.unpack_tuple(builder, args[2], count)
    for part, sums in enumerate(_emit_sums(builder, given + [None] * (16 - count))):
        row = ir.Constant(kind.llvm, None) if sums is None else sums
        memory.store(part * kind.lanes, row)


@emitted(
    lambda array, offset, stride, channels: types.void(array, types.intp, types.intp, channels)
)
def store_pixels(context: Any, builder: Any, sig: Any, args: Any) -> None:
    """Write rows of four pixels, ``stride`` numbers apart, with interleaved channels."""
    count, rows = len(sig.args[3]), sig.args[3][0].lanes // 4
    memory = _Rows(context, builder, sig, args)
    vectors = cgutils.unpack_tuple(builder, args[3], count)
    at = memory.index(0)
    for row in range(rows):
        for first in range(0, count, 2):
            flat = range(4 * first, 4 * min(first + 2, count))
            picks = [(k % count, 4 * row + k // count) for k in flat]
            place = builder.add(at, memory.index(4 * first))
            memory.store(place, _emit_pick(builder, vectors, picks))
        at = builder.add(at, args[2])


def make_load_pixels(channels: int, lanes: int) -> Callable:
    """Make a function that reads this many channels of blocks of pixels."""

    @emitted(lambda array, offset, stride: _vectors(channels, lanes)(array, types.intp, types.intp))
    def load_pixels(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Interleaved channels of rows of four pixels, ``stride`` numbers apart."""
        memory = _Rows(context, builder, sig, args)
        at, parts = memory.index(0), []
        for _ in range(lanes // 4):
            starts = [builder.add(at, memory.index(4 * first)) for first in range(channels)]
            parts += [memory.load(start, 4) for start in starts]
            at = builder.add(at, args[2])
        vectors = []
        for c in range(channels):
            flat = [(lane // 4, channels * (lane % 4) + c) for lane in range(lanes)]
            picks = [(channels * row + k // 4, k % 4) for row, k in flat]
            vectors.append(_emit_pick(builder, parts, picks))
        return context.make_tuple(builder, sig.return_type, vectors)

    return load_pixels
