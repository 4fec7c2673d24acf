"""Kernels of the multiresolution hash grid."""

from __future__ import annotations

from numba import prange
from numpy import empty, float32, int32, int64

from chronoscene.kernels.compilation import inlined, kernel
from chronoscene.kernels.memory import load, load_high_pairs, load_low_pairs, make_load, store
from chronoscene.kernels.transposes import make_load_columns
from chronoscene.kernels.vector_math import high_pairs, low_pairs
from chronoscene.kernels.vectors import (
    LANES,
    absolute,
    any_lane,
    multiply_add,
    splat,
    to_float,
    to_int,
)

BLOCK = 8192  # Places of a task, at least
PRIMES = (2654435761, 805459861)
CORNERS = 8
_TILE = 64  # Places whose gradients are sorted by level together
ONE = float32(1)
ZERO = float32(0)
_load_pair, _load_places = make_load(2), make_load_columns(3, LANES)


@inlined
def _locate(places, i, cells):  # type: ignore[no-untyped-def]
    """Cell of LANES places and their shares of the way to its far corner, by axis."""
    px, py, pz = _load_places(places, 3 * i)
    px, py, pz = px * cells, py * cells, pz * cells
    x, y, z = to_int(px), to_int(py), to_int(pz)
    return (x, y, z), (px - to_float(x), py - to_float(y), pz - to_float(z))


@inlined
def _corner(corner, cell, share, factors, dense, start, mask):  # type: ignore[no-untyped-def]
    """Row of a corner of LANES cells in the table, and its weight; ``corner`` is a constant."""
    cx, cy, cz = corner & 1, (corner >> 1) & 1, corner >> 2
    fx, fy, fz = share
    weight = (fx if cx else ONE - fx) * (fy if cy else ONE - fy) * (fz if cz else ONE - fz)
    x, y, z = cell[0] + cx, (cell[1] + cy) * factors[0], (cell[2] + cz) * factors[1]
    return start + (x + y + z if dense else (x ^ y ^ z) & mask), weight


@inlined
def _level(resolutions, starts, dense, level):  # type: ignore[no-untyped-def]
    """Numbers of a level that `_corner` reads: factors of y and z, first row, mask of rows."""
    points = int32(resolutions[level] + 1)
    y = points if dense[level] else int32(PRIMES[0])
    z = int32(points * points) if dense[level] else int32(PRIMES[1])
    mask = int32(starts[level + 1] - starts[level] - 1)
    return (y, z), int32(starts[level]), mask


@kernel(fast_math=True, parallel=True)
def encode_forward(places, count, table, resolutions, starts, dense, tasks, out):  # type: ignore[no-untyped-def]
    """Interpolate the features of all levels; arguments as of `grid.encode`.

    A level fills the cache, so a task reads it once, for all of its places. Rows and weights are
    computed for LANES places at once; pairs of features are loaded one by one, as gathers are slow
    on many processors.

    Args:
        places: With rows of zeros up to a multiple of LANES. Flat [N, 3]
        count: N without these.
        table: Flat [E, 2].
        resolutions: Cells along an edge. int64 [L]
        starts: First row of each level, and the end. int64 [L + 1]
        dense: Whether each grid point has a row of its own. bool [L]
        tasks: Into how many tasks to divide the places, at most; does not change the result.
        out: Written. Flat [N, 2 L].
    """
    levels = resolutions.shape[0]
    size = max(BLOCK, (count // LANES // tasks + 1) * LANES)
    for task in prange((count + size - 1) // size):
        pairs = empty(2 * LANES, float32)
        for level in range(levels):
            factors, start, mask = _level(resolutions, starts, dense, level)
            cells, is_dense = float32(resolutions[level]), dense[level]
            for i in range(task * size, min(count, (task + 1) * size), LANES):
                cell, share = _locate(places, i, cells)
                low, high = splat(ZERO), splat(ZERO)
                for corner in range(CORNERS):
                    row, weight = _corner(corner, cell, share, factors, is_dense, start, mask)
                    low = multiply_add(load_low_pairs(table, row), low_pairs(weight), low)
                    high = multiply_add(load_high_pairs(table, row), high_pairs(weight), high)
                store(pairs, 0, low)
                store(pairs, LANES, high)
                for lane in range(min(LANES, count - i)):
                    store(out, 2 * ((i + lane) * levels + level), _load_pair(pairs, 2 * lane))


@kernel(fast_math=True, parallel=True)
def encode_backward(  # type: ignore[no-untyped-def]
    places, count, grads, resolutions, starts, dense, tasks, by_level, out
):
    """Add the gradient of the table; a level belongs to one task, so that sums have one order.

    Args:
        grads: Of the output of `encode_forward`. Flat [N, 2 L].
        tasks: Into how many tasks to divide the levels; does not change the result.
        by_level: Written: the gradients in the order [L, N, 2], which a level reads in turn.
            Flat, with 2 LANES numbers more.
        out: Zeros, added to. Flat [E, 2].
    """
    levels = resolutions.shape[0]
    for tile in prange((count + _TILE - 1) // _TILE):
        for level in range(levels):
            for i in range(tile * _TILE, min(count, (tile + 1) * _TILE)):
                store(
                    by_level, 2 * (level * count + i), _load_pair(grads, 2 * (i * levels + level))
                )
    for task in prange(tasks):
        rows, weights = empty(CORNERS * LANES, int32), empty(CORNERS * LANES, float32)
        for level in range(task, levels, tasks):
            factors, start, mask = _level(resolutions, starts, dense, level)
            cells, is_dense = float32(resolutions[level]), dense[level]
            for i in range(0, count, LANES):
                at = 2 * (level * count + i)
                some = absolute(load(by_level, at)) + absolute(load(by_level, at + LANES))
                if not any_lane(some > ZERO):
                    continue
                cell, share = _locate(places, i, cells)
                for corner in range(CORNERS):
                    row, weight = _corner(corner, cell, share, factors, is_dense, start, mask)
                    store(rows, corner * LANES, row)
                    store(weights, corner * LANES, weight)
                for lane in range(min(LANES, count - i)):
                    grad = _load_pair(by_level, at + 2 * lane)
                    for corner in range(CORNERS):
                        row, weight = rows[corner * LANES + lane], weights[corner * LANES + lane]
                        sum_ = multiply_add(grad, weight, _load_pair(out, 2 * int64(row)))
                        store(out, 2 * int64(row), sum_)
