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
from chronoscene.kernels.matmul import ROW_TILE, pair_product
from chronoscene.kernels.vectors import LANES

Integers = NDArray[np.int32]

MAX_RATIO = 0.8
"""COLMAP's, of the distance to the nearest descriptor and that to the second nearest."""

MAX_DISTANCE = 0.7  # COLMAP's, in lengths of a descriptor, which is 512

PAIRS = 64  # Pairs of numbers in a descriptor
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
    doubled: Integers
    """Twice the values, in pairs of int16, by groups of COLUMNS descriptors.
    [groups, PAIRS, COLUMNS]"""
    squares: Integers
    """Minus the squared length of each. [groups * COLUMNS]"""

    @classmethod
    def of(cls, values: NDArray[np.uint8]) -> Descriptors:
        groups = -(-len(values) // COLUMNS)
        padded = np.zeros((groups * COLUMNS, 2 * PAIRS), np.int16)
        padded[: len(values)] = values
        doubled = (2 * padded).view(np.int32).reshape(groups, COLUMNS, PAIRS)
        squares = np.full(len(padded), NOWHERE, np.int32)
        squares[: len(values)] = -_squares(values)
        return cls(values, np.ascontiguousarray(doubled.transpose(0, 2, 1)), squares)


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
    padded = np.zeros((-(-len(queries) // ROW_TILE) * ROW_TILE, 2 * PAIRS), np.int16)
    padded[: len(queries)] = queries
    found = np.empty((3, len(padded)), np.int32)
    _search(padded.view(np.int32), searched.doubled, searched.squares, *found)
    index, *largest = found[:, : len(queries)]
    least, second = (_squares(queries) - score for score in largest)
    return index, (least <= _FARTHEST) & (_RATIO * least < second)


@kernel
def _search(queries, doubled, squares, index, most, next_most):  # type: ignore[no-untyped-def]
    """Largest and second largest 2 q d - |d|^2 of each query, and the index of the largest.

    Args:
        queries: In pairs of int16. [Q, PAIRS]
        doubled: See `Descriptors`.
        squares: See `Descriptors`.
        index: [Q]
        most: [Q]
        next_most: [Q]
    """
    scores = np.empty((ROW_TILE, CHUNK), np.int32)
    lowest = np.int32(2 * NOWHERE)
    most[:] = next_most[:] = lowest
    for start in range(0, len(squares), CHUNK):
        count = min(CHUNK, len(squares) - start)
        for top in range(0, len(queries), ROW_TILE):
            left = (queries, top * PAIRS, PAIRS, 1)
            for column in range(0, count, COLUMNS):
                right = (doubled, (start + column) * PAIRS, COLUMNS)
                first, out = (squares, start + column, 0), (scores, column, CHUNK)
                pair_product(left, right, first, out, ROW_TILE, COLUMNS, PAIRS)
            for i in range(top, top + ROW_TILE):
                row = scores[i - top, :count]
                best = lowest
                for score in row:
                    best = max(best, score)
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
