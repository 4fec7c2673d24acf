"""Positions on a grid: their order along a Morton curve, and the octree that they fill.

Source: Morton 1966 for the order; Schnabel and Klein 2006 for octrees whose nodes say by one byte
which of their children hold a point.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.compression.symbols import Reader, Writer

DEPTH = 20
"""Levels of the octree of positions that lie on no grid."""
MAX_DEPTH = 21
"""Three coordinates of so many bits fit into 64."""


@dataclass(frozen=True, slots=True, eq=False)
class Grid:
    """Regular grid that positions are rounded to."""

    origin: NDArray[np.float64]
    """[3]"""
    step: float

    @classmethod
    def of(cls, positions: NDArray[np.floating], cell: float | None) -> Grid:
        """The grid of a given cell if the positions lie on it, else a fine one around them.

        Args:
            positions: Finite. [N, 3]
            cell: Size of a cell, on a multiple of which a coordinate may lie.
        """
        low = positions.min(axis=0).astype(np.float64)
        extent = float(np.max(positions.max(axis=0) - low))
        if cell is not None and cell > 0 and extent / cell < 2**MAX_DEPTH - 1:
            cells = positions / cell
            if np.abs(cells - np.rint(cells)).max() < 0.01:
                return cls(np.rint(low / cell) * cell, cell)
        return cls(low, extent / (2**DEPTH - 1) or 1.0)

    def codes(self, positions: NDArray[np.floating]) -> NDArray[np.int64]:
        """Coordinates in steps from the origin. [N, 3]"""
        return np.rint((positions - self.origin) / self.step).astype(np.int64)

    def positions(self, codes: NDArray[np.int64]) -> NDArray[np.float32]:
        """Inverse of `codes`, to half a step. [N, 3]"""
        return (self.origin + codes * self.step).astype(np.float32)


def morton(codes: NDArray[np.int64]) -> NDArray[np.int64]:
    """Places along the curve. [N, 3] -> [N]"""
    places = np.zeros(len(codes), np.int64)
    for bit in range(MAX_DEPTH):
        for axis in range(3):
            places |= (codes[:, axis] >> bit & 1) << 3 * bit + axis
    return places


def from_morton(places: NDArray[np.int64]) -> NDArray[np.int64]:
    """Inverse of `morton`. [N] -> [N, 3]"""
    codes = np.zeros((len(places), 3), np.int64)
    for bit in range(MAX_DEPTH):
        for axis in range(3):
            codes[:, axis] |= (places >> 3 * bit + axis & 1) << bit
    return codes


def write_octree(writer: Writer, places: NDArray[np.int64]) -> None:
    """Write places in ascending order."""
    leaves, counts = np.unique(places, return_counts=True)
    levels: list[NDArray[np.int64]] = []
    while not levels or leaves[-1]:
        nodes, parents = np.unique(leaves >> 3, return_inverse=True)
        bytes_ = np.zeros(len(nodes), np.int64)
        np.bitwise_or.at(bytes_, parents, 1 << (leaves & 7))
        levels.append(bytes_)
        leaves = nodes
    writer.numbers([len(levels)], "u1")
    for bytes_ in reversed(levels):
        writer.symbols(bytes_)
    writer.symbols(counts)


def read_octree(reader: Reader, count: int) -> NDArray[np.int64]:
    """Inverse of `write_octree`."""
    (depth,) = reader.numbers(1, "u1")
    reader.check(1 <= depth <= MAX_DEPTH, "the depth of an octree")
    nodes, children = np.zeros(1, np.int64), np.arange(8)
    for _ in range(depth):
        bytes_ = reader.symbols(len(nodes))
        there = (bytes_[:, None] >> children & 1).astype(bool)
        nodes = (nodes[:, None] << 3 | children)[there]
        reader.check(1 <= len(nodes) <= count, "the nodes of an octree")
    counts = reader.symbols(len(nodes))
    reader.check(counts.min() > 0 and counts.sum() == count, "the points of an octree")
    return np.repeat(nodes, counts)
