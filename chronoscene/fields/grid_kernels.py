"""Kernels of the multiresolution hash grid."""

from __future__ import annotations

from numba import prange
from numpy import float32, int64, uint32

from chronoscene.kernels.compilation import inlined, kernel
from chronoscene.kernels.memory import make_load, read, store
from chronoscene.kernels.vectors import make_splat, multiply_add

BLOCK = 8192  # Places of a task, at least
PRIMES = (uint32(2654435761), uint32(805459861))
ONE = float32(1)
ZERO = float32(0)
# Pairs of features, rather than several places at once: gathers are slow on many processors.
_load_pair, _pair = make_load(2), make_splat("f32", 2)


@inlined
def _row(dense, points, mask, x, y, z):  # type: ignore[no-untyped-def]
    """Row of a grid point in the table of its level."""
    if dense:
        return int64(x) + points * (int64(y) + points * int64(z))
    return int64((uint32(x) ^ (uint32(y) * PRIMES[0]) ^ (uint32(z) * PRIMES[1])) & mask)


@kernel(fast_math=True, parallel=True)
def encode_forward(places, table, resolutions, starts, dense, tasks, out):  # type: ignore[no-untyped-def]
    """Interpolate the features of all levels; arguments as of `grid.encode`.

    A level fills the cache, so a task reads it once, for all of its places.

    Args:
        places: [N, 3]
        table: Flat [E, 2].
        resolutions: Cells along an edge. int64 [L]
        starts: First row of each level, and the end. int64 [L + 1]
        dense: Whether each grid point has a row of its own. bool [L]
        tasks: Into how many tasks to divide the places, at most; does not change the result.
        out: Written. Flat [N, 2 L].
    """
    count, levels = places.shape[0], resolutions.shape[0]
    size = max(BLOCK, (count + tasks - 1) // tasks)
    for task in prange((count + size - 1) // size):
        for level in range(levels):
            cells, start = float32(resolutions[level]), starts[level]
            points, mask = resolutions[level] + 1, uint32(starts[level + 1] - start - 1)
            is_dense = dense[level]
            for i in range(task * size, min(count, (task + 1) * size)):
                px, py, pz = places[i, 0] * cells, places[i, 1] * cells, places[i, 2] * cells
                x, y, z = int(px), int(py), int(pz)
                fx, fy, fz = px - float32(x), py - float32(y), pz - float32(z)
                total = _pair(ZERO)
                for corner in range(8):
                    cx, cy, cz = corner & 1, (corner >> 1) & 1, corner >> 2
                    weight = (
                        (fx if cx else ONE - fx)
                        * (fy if cy else ONE - fy)
                        * (fz if cz else ONE - fz)
                    )
                    row = start + _row(is_dense, points, mask, x + cx, y + cy, z + cz)
                    total = multiply_add(_load_pair(table, 2 * row), weight, total)
                store(out, 2 * (i * levels + level), total)


@kernel(fast_math=True, parallel=True)
def encode_backward(places, grads, resolutions, starts, dense, tasks, out):  # type: ignore[no-untyped-def]
    """Add the gradient of the table; a level belongs to one task, so that sums have one order.

    Args:
        grads: Of the output of `encode_forward`. Flat [N, 2 L].
        tasks: Into how many tasks to divide the levels; does not change the result.
        out: Zeros, added to. Flat [E, 2].
    """
    count, levels = places.shape[0], resolutions.shape[0]
    for task in prange(tasks):
        for level in range(task, levels, tasks):
            cells, start = float32(resolutions[level]), starts[level]
            points, mask = resolutions[level] + 1, uint32(starts[level + 1] - start - 1)
            is_dense = dense[level]
            for i in range(count):
                at = 2 * (i * levels + level)
                if read(grads, at) == ZERO and read(grads, at + 1) == ZERO:
                    continue
                grad = _load_pair(grads, at)
                px, py, pz = places[i, 0] * cells, places[i, 1] * cells, places[i, 2] * cells
                x, y, z = int(px), int(py), int(pz)
                fx, fy, fz = px - float32(x), py - float32(y), pz - float32(z)
                for corner in range(8):
                    cx, cy, cz = corner & 1, (corner >> 1) & 1, corner >> 2
                    weight = (
                        (fx if cx else ONE - fx)
                        * (fy if cy else ONE - fy)
                        * (fz if cz else ONE - fz)
                    )
                    row = start + _row(is_dense, points, mask, x + cx, y + cy, z + cz)
                    store(out, 2 * row, multiply_add(grad, weight, _load_pair(out, 2 * row)))
