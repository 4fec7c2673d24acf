"""What did not move: a consensus that counts places instead of matches.

A heap of sand that grew, or a row of parked cars, can bring more matches than the buildings around
it. Points are therefore put into cells of space, and each cell has the same say, in drawing samples
and in judging them. A change fills few cells, however much texture it has.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

CELLS_PER_AXIS = 12
"""Along each of the two directions in which the points spread most."""

LOWEST_QUANTILE = 0.02
"""Points outside of this quantile and its mirror image do not stretch the grid."""


def cells(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """Cell of each point, numbered without gaps. [N, 3] -> [N]

    The grid lies in the plane of the two principal directions: scenes are wide and flat.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.quantile(points, [LOWEST_QUANTILE, 1 - LOWEST_QUANTILE], axis=0)
    inside = np.clip(points, low, high)
    centred = inside - inside.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ axes[:2].T
    extent = max(float(np.ptp(flat, axis=0).max()), 1e-12)
    index = np.floor((flat - flat.min(axis=0)) / extent * CELLS_PER_AXIS).astype(np.int64)
    index = np.minimum(index, CELLS_PER_AXIS - 1)
    key = np.zeros(len(points), np.int64)
    for column in range(index.shape[1]):
        key = key * CELLS_PER_AXIS + index[:, column]
    return np.asarray(np.unique(key, return_inverse=True)[1], np.int64)


def cell_weights(cell: NDArray[np.int64]) -> NDArray[np.float64]:
    """Weight of each point such that a cell counts as the root of its number of points. [N]

    Between one vote for each point and one for each cell: an almost empty cell may be an accident.
    """
    counts = np.bincount(cell) if len(cell) else np.ones(1)
    return 1.0 / np.sqrt(counts[cell])


def draw(
    rng: np.random.Generator, members: list[NDArray[np.int64]], count: int
) -> NDArray[np.int64] | None:
    """Points of as many different cells; None if there are too few cells. [count]"""
    if len(members) < count:
        return None
    chosen = rng.choice(len(members), count, replace=False)
    return np.array([members[c][rng.integers(len(members[c]))] for c in chosen])


def cell_members(cell: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Points of each cell."""
    order = np.argsort(cell, kind="stable")
    edges = np.flatnonzero(np.diff(cell[order])) + 1
    return np.split(order, edges) if len(order) else []
