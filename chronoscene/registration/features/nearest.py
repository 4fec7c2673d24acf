"""Matches between the descriptors of two images: exact nearest neighbours by matrix products.

Descriptors are bytes, so all products and squared distances are whole numbers: the result is the
same with every order of the sums, number of threads and processor.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Mask
from chronoscene.kernels.compilation import kernel
from chronoscene.kernels.matmul import ROW_TILE, byte_product, pair_product
from chronoscene.kernels.vectors import BYTE_PRODUCTS, LANES

Integers = NDArray[np.int32]

MAX_RATIO = 0.8
"""COLMAP's, of the distance to the nearest descriptor and that to the second nearest."""

MAX_DISTANCE = 0.7  # COLMAP's, in lengths of a descriptor, which is 512

SIZE = 128  # Numbers in a descriptor

_TYPE, _product = (np.int8, byte_product) if BYTE_PRODUCTS else (np.int16, pair_product)
WORDS = SIZE * np.dtype(_TYPE).itemsize // 4  # Of 32 bits in a descriptor, as products read them

MIDDLE = 128  # Subtracted from the numbers that are searched, so that they are bytes with a sign

COLUMNS = 2 * LANES  # Descriptors that a product reads side by side
CHUNK = 512  # Descriptors that a cache holds while all queries pass by; a multiple of COLUMNS
NOWHERE = -(2**30)  # Minus the squared length of what fills up the last columns

_FARTHEST = (512 * MAX_DISTANCE) ** 2
_RATIO = np.float32(1 / MAX_RATIO**2)


@dataclass(frozen=True, slots=True, eq=False)
class Descriptors:
    """Descriptors of an image, also in the memory layout of the search."""

    values: NDArray[np.uint8]
    """[N, 128]"""
    centred: Integers
    """The values minus MIDDLE, packed into words, by groups of COLUMNS descriptors.
    [groups, WORDS, COLUMNS]"""
    squares: Integers
    """Minus the squared length of each. [groups * COLUMNS]"""

    @classmethod
    def of(cls, values: NDArray[np.uint8]) -> Descriptors:
        groups = -(-len(values) // COLUMNS)
        padded = np.zeros((groups * COLUMNS, SIZE), _TYPE)
        padded[: len(values)] = values.astype(np.int16) - MIDDLE
        centred = padded.view(np.int32).reshape(groups, COLUMNS, WORDS)
        squares = np.full(len(padded), NOWHERE, np.int32)
        squares[: len(values)] = -_squares(values)
        return cls(values, np.ascontiguousarray(centred.transpose(0, 2, 1)), squares)


def mutual_matches(first: Descriptors, second: Descriptors) -> NDArray[np.uint32]:
    """Match descriptors that are mutual nearest neighbours and pass the ratio test both ways.

    A descriptor with two nearest neighbours at the same distance has no match. The ratio is not
    tested where the other image has a single descriptor.

    Args:
        first: Descriptors of one image.
        second: Descriptors of the other.

    Returns:
        Indices, sorted by the first. [M, 2]
    """
    if not len(first.values) or not len(second.values):
        return np.zeros((0, 2), np.uint32)
    columns, clear = _nearest(first.values, second)
    rows, columns = np.flatnonzero(clear), columns[clear]
    back, clear = _nearest(second.values[columns], first)
    mutual = clear & (back == rows)
    return np.column_stack([rows[mutual], columns[mutual]]).astype(np.uint32)


def _squares(values: NDArray[np.uint8]) -> Integers:
    """Squared lengths of rows."""
    return np.asarray(np.square(values, dtype=np.int32).sum(axis=1, dtype=np.int32))


def _nearest(queries: NDArray[np.uint8], searched: Descriptors) -> tuple[NDArray[np.int32], Mask]:
    """Index of the nearest descriptor, and True where it passes both tests. [Q], [Q]"""
    kind = np.dtype(f"u{np.dtype(_TYPE).itemsize}")
    padded = np.zeros((-(-len(queries) // ROW_TILE) * ROW_TILE, SIZE), kind)
    padded[: len(queries)] = queries
    found = np.empty((3, len(padded)), np.int32)
    _search(padded.view(np.int32), searched.centred, searched.squares, *found)
    index, *largest = found[:, : len(queries)]
    # |q - d|^2 = |q|^2 - 2 q MIDDLE - (2 q (d - MIDDLE) - |d|^2)
    base = _squares(queries) - 2 * MIDDLE * queries.sum(axis=1, dtype=np.int32)
    least, second = (base - score for score in largest)
    return index, (least <= _FARTHEST) & (_RATIO * least < second)


@kernel
def _search(queries, centred, squares, index, most, next_most):  # type: ignore[no-untyped-def]
    """Largest and second largest 2 q (d - MIDDLE) - |d|^2 of each query; index of the largest.

    Args:
        queries: Packed into words. [Q, WORDS]
        centred: See `Descriptors`.
        squares: See `Descriptors`.
        index: [Q]
        most: [Q]
        next_most: [Q]
    """
    scores = np.empty((ROW_TILE, CHUNK), np.int32)
    nothing = np.zeros(COLUMNS, np.int32)
    lowest = np.int32(2 * NOWHERE)
    most[:] = next_most[:] = lowest
    for start in range(0, len(squares), CHUNK):
        count = min(CHUNK, len(squares) - start)
        own = squares[start : start + count]
        for top in range(0, len(queries), ROW_TILE):
            left = (queries, top * WORDS, WORDS, 1)
            for column in range(0, count, COLUMNS):
                right = (centred, (start + column) * WORDS, COLUMNS)
                first, out = (nothing, 0, 0), (scores, column, CHUNK)
                _product(left, right, first, out, ROW_TILE, COLUMNS, WORDS)
            for i in range(top, top + ROW_TILE):
                row = scores[i - top, :count]
                best = lowest
                for j in range(count):
                    row[j] = 2 * row[j] + own[j]
                    best = max(best, row[j])
                if best <= most[i]:
                    next_most[i] = max(next_most[i], best)
                    continue
                place = 0
                while row[place] != best:
                    place += 1
                row[place] = lowest
                following = most[i]
                for score in row:
                    following = max(following, score)
                index[i], most[i], next_most[i] = start + place, best, following
