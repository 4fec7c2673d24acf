"""Adam on some rows and blocks of columns of a table, compiled. See `row_adam`."""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import prange
from numpy import float32

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import load_first, read, read_index, store_first, write_index
from chronoscene.kernels.vectors import LANES, select, splat, sqrt
from chronoscene.training.adam_kernel import (
    BETA2,
    GAIN1,
    GAIN2,
    KEEP2,
    TINY_MEAN,
    TINY_SQUARE,
)

LOG_BETA2 = math.log(BETA2)
WAY_PARTS = 3
"""Numbers for each gap: way over mean / root of square, and what is left of the two moments."""
CHUNK = 256
"""Rows that a task takes at a time."""
ZERO = float32(0)


class Table(NamedTuple):
    """Addresses and lengths of a table and its moments."""

    values: int
    """[R, columns]"""
    means: int
    squares: int
    columns: int
    stamps: int
    """Step up to which a row and block is done. int64 [R, blocks]"""
    blocks: int


class Part(NamedTuple):
    """Addresses and lengths of what a step reads of a table."""

    rows: int
    """Each once. int64 [M]"""
    num_rows: int
    places: int
    """(block, first column, columns, first column in the copy) of each block. int64 [b, 4]"""
    num_places: int
    columns: int
    """Of the copy."""


@inner
def _clean(mean, square):  # type: ignore[no-untyped-def]
    """Moments without denormal numbers; see `_adam_kernel`."""
    least, zero = splat(TINY_MEAN), splat(ZERO)
    mean = select(mean < least, select(zero - least < mean, zero, mean), mean)
    return mean, select(square < splat(TINY_SQUARE), zero, square)


@inner
def _wait_of(table, stamp_at, now, ways, longest, settled):  # type: ignore[no-untyped-def]
    """Way, and what is left of the moments, of a row and block that was not read for a while."""
    stamp = read_index(table.stamps, stamp_at)
    gap = now - stamp
    if gap <= longest:
        at = WAY_PARTS * gap
        return read(ways, at), read(ways, at + 1), read(ways, at + 2)
    return read(settled, stamp), ZERO, float32(math.exp(gap * LOG_BETA2))


@inner
def _copy(table, at, width, way, eps, out, to):  # type: ignore[no-untyped-def]
    """The numbers of one row and block after their wait."""
    for c in range(0, width, LANES):
        left = width - c
        value = load_first(table.values, at + c, left)
        if way != ZERO:
            mean = load_first(table.means, at + c, left)
            root = sqrt(load_first(table.squares, at + c, left))
            value = value - way * mean / (root + eps)
        store_first(out, to + c, value, left)


@kernel(parallel=True)
def fetch(table, part, now, ways, longest, settled, eps, out):  # type: ignore[no-untyped-def]
    """Copy rows as they are at the present step.

    Args:
        table: `Table`.
        part: `Part`.
        now: Present step.
        ways: Address of numbers for each wait of 0..longest steps. float32 [G + 1, WAY_PARTS]
        longest: G; what waited longer has gone all its way.
        settled: Address of the way of those, by their stamp. float32
        eps: As a part of the root.
        out: Address of the copies. [M, columns]
    """
    for task in prange((part.num_rows + CHUNK - 1) // CHUNK):
        for m in range(task * CHUNK, min((task + 1) * CHUNK, part.num_rows)):
            row = read_index(part.rows, m)
            for b in range(part.num_places):
                stamp_at = row * table.blocks + read_index(part.places, 4 * b)
                at = row * table.columns + read_index(part.places, 4 * b + 1)
                width = read_index(part.places, 4 * b + 2)
                to = m * part.columns + read_index(part.places, 4 * b + 3)
                way, _, _ = _wait_of(table, stamp_at, now, ways, longest, settled)
                _copy(table, at, width, way, eps, out, to)


@inner
def _step(table, at, width, keep, copies, grads, to, scalars):  # type: ignore[no-untyped-def]
    keep1, keep2 = keep
    rate, root, eps = scalars
    for c in range(0, width, LANES):
        left = width - c
        grad = load_first(grads, to + c, left)
        mean = keep1 * load_first(table.means, at + c, left)
        mean = mean + GAIN1 * (grad - mean)
        square = (KEEP2 * keep2) * load_first(table.squares, at + c, left)
        mean, square = _clean(mean, square + GAIN2 * grad * grad)
        moved = rate * mean / (sqrt(square) * root + eps)
        store_first(table.values, at + c, load_first(copies, to + c, left) - moved, left)
        store_first(table.means, at + c, mean, left)
        store_first(table.squares, at + c, square, left)


@kernel(parallel=True)
def update(table, part, now, ways, longest, settled, copies, grads, scalars):  # type: ignore[no-untyped-def]
    """One step of Adam for rows that were fetched; see `_adam_kernel`.

    Args:
        table, part, now, ways, longest, settled: As in `fetch`.
        copies: Address of what it wrote.
        grads: Address of the gradients of the copies.
        scalars: rate, root and eps, as in `_adam_kernel.adam_block`.
    """
    for task in prange((part.num_rows + CHUNK - 1) // CHUNK):
        for m in range(task * CHUNK, min((task + 1) * CHUNK, part.num_rows)):
            row = read_index(part.rows, m)
            for b in range(part.num_places):
                stamp_at = row * table.blocks + read_index(part.places, 4 * b)
                at = row * table.columns + read_index(part.places, 4 * b + 1)
                width = read_index(part.places, 4 * b + 2)
                to = m * part.columns + read_index(part.places, 4 * b + 3)
                _, keep1, keep2 = _wait_of(table, stamp_at, now, ways, longest, settled)
                _step(table, at, width, (keep1, keep2), copies, grads, to, scalars)
                write_index(table.stamps, stamp_at, now + 1)
