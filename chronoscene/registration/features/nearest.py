"""Matches between the descriptors of two images: exact nearest neighbours by matrix products.

Descriptors are bytes, so all sums in a squared distance are whole numbers below 2^24, which float32
holds exactly: the result is the same with every size of the blocks, library and processor.

Most descriptors have no match, which half of the dimensions can show: a distance within a subspace
is never larger than the whole one. Only the others are compared in all dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float32]

MAX_RATIO = 0.8
"""COLMAP's, of the distance to the nearest descriptor and that to the second nearest."""

MAX_DISTANCE = 0.7
"""COLMAP's, in lengths of a descriptor, which is 512."""

SUBSPACE = 56  # Dimensions; with fewer, a product is faster but shows less
ROWS = 96  # Of a block: with 5,000 columns it takes 2 MB, which caches hold

SLACK = 64.0
"""Subtracted from squared distances in the subspace: much more than rounding can add to them, and
much less than they are."""

_FARTHEST = np.float32((512 * MAX_DISTANCE) ** 2)
_RATIO = np.float32(1 / MAX_RATIO**2)


def subspace(descriptors: NDArray[np.uint8]) -> Float:
    """Orthonormal basis of the directions in which descriptors vary most. [128, SUBSPACE]"""
    centred = descriptors - descriptors.sum(axis=0) / max(len(descriptors), 1)
    return np.linalg.eigh(centred.T @ centred)[1][:, -SUBSPACE:].astype(np.float32)


@dataclass(frozen=True, slots=True, eq=False)
class Descriptors:
    """Those of an image, and their place in a subspace."""

    values: NDArray[np.uint8]
    """[N, 128]"""
    projected: Float
    """With the squared length in a last column. [N, SUBSPACE + 1]"""

    @classmethod
    def of(cls, values: NDArray[np.uint8], basis: Float) -> Descriptors:
        return cls(values, _with_squares(values.astype(np.float32) @ basis))


def mutual_matches(first: Descriptors, second: Descriptors) -> NDArray[np.uint32]:
    """Pairs of descriptors that are each other's nearest, by far in both directions.

    One with two nearest at the same distance has no match. Where an image has one descriptor, there
    is no second nearest, and the ratio is not tested.

    Args:
        first: Of one image, N of them.
        second: Of the other, in the same subspace.

    Returns:
        Indices, sorted by the first. [M, 2]
    """
    if not len(first.values) or not len(second.values):
        return np.zeros((0, 2), np.uint32)
    rows = _undecided(first, second)
    columns, clear = _nearest(first.values[rows], second.values)
    rows, columns = rows[clear], columns[clear]
    back, clear = _nearest(second.values[columns], first.values)
    mutual = clear & (back == rows)
    return np.column_stack([rows[mutual], columns[mutual]]).astype(np.uint32)


def _with_squares(values: Float) -> Float:
    """Rows with their squared lengths in a last column. [N, D] -> [N, D + 1]"""
    return np.column_stack([values, np.einsum("ij,ij->i", values, values)])


def _distances(queries: Float, searched: Float) -> Float:
    """|q - d|^2 - |q|^2, as the product (-2 q, 1) (d, |d|^2). [Q, N]"""
    factors = -2 * queries
    factors[:, -1] = 1
    return factors @ searched.T


def _nearest(
    query_values: NDArray[np.uint8], searched_values: NDArray[np.uint8]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Nearest of the searched descriptors, and whether it passes distance and ratio. [Q], [Q]"""
    queries, searched = (
        _with_squares(v.astype(np.float32)) for v in (query_values, searched_values)
    )
    nearest = np.zeros(len(queries), np.intp)
    clear = np.zeros(len(queries), bool)
    for start in range(0, len(queries), ROWS):
        block = slice(start, start + ROWS)
        distances = _distances(queries[block], searched)
        best, least = _pop_least(distances)
        length = queries[block, -1]
        nearest[block] = best
        least, second = least + length, distances.min(axis=1) + length
        clear[block] = (least <= _FARTHEST) & (_RATIO * least < second)
    return nearest, clear


def _pop_least(distances: Float) -> tuple[NDArray[np.intp], Float]:
    """Column and value of the least of each row, which infinity replaces. [Q], [Q]"""
    rows, best = np.arange(len(distances)), distances.argmin(axis=1)
    least = distances[rows, best]
    distances[rows, best] = np.inf
    return best, least


def _undecided(first: Descriptors, second: Descriptors) -> NDArray[np.intp]:
    """Rows of the first that may have a match as far as the subspace shows.

    No distance is less than the least in the subspace, and the second least is not more than the
    larger one of any two: those to the two nearest in the subspace.
    """
    rows = []
    for start in range(0, len(first.values), ROWS):
        block = slice(start, start + ROWS)
        queries, values = first.projected[block], first.values[block]
        distances = _distances(queries, second.projected)
        one, least = _pop_least(distances)
        two = distances.argmin(axis=1)
        bound = least + queries[:, -1] - SLACK
        second_least = np.maximum(*(_between(values, second.values[i]) for i in (one, two)))
        undecided = (bound <= _FARTHEST) & (_RATIO * bound < second_least)
        rows.append(start + np.flatnonzero(undecided | (one == two)))
    return np.concatenate(rows)


def _between(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> Float:
    """Squared distances between rows. [N, 128], [N, 128] -> [N]"""
    apart = np.subtract(a, b, dtype=np.float32)
    return np.asarray(np.einsum("ij,ij->i", apart, apart), np.float32)
