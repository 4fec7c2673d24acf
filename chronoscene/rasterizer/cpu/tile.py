"""Where the pixels of a tile lie, as seen from a Gaussian: what both compositing passes compute.

A vector holds the pixels of one block, or of half a block where vectors are narrow. What a pass
keeps of a tile is ordered by block, so that a vector is one aligned load, and all that belongs to a
block lies together: planes a power of two apart would collide in the processor's store buffer.
"""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.rasterizer.cpu import sizes as lay
from chronoscene.rasterizer.cpu.kernel import inlined
from chronoscene.rasterizer.cpu.simd import LANES, make_constant, splat, store

PARTS = 16 // LANES
"""Vectors per block."""
PART_ROWS = LANES // 4
AHEAD = 6
"""Entries by which records are asked for in advance."""

_lane_x = make_constant([i % 4 + 0.5 for i in range(LANES)])
_lane_y = make_constant([i // 4 + 0.5 for i in range(LANES)])
_block_steps = make_constant([4.0 * i for i in range(8)])


@inlined
def whitened(records: Any, at: int, left: Any, top: Any, state: Any, steps: int) -> Any:
    """Level of a Gaussian, (u, v) of the pixels of a tile's first block, and `offset`'s shift.

    How u and v change from block to block goes into numbers of ``state``: 8 of u by column, 8 of u
    by row, 8 of v by row or by column, 1 of v by row. Adding them costs less than multiplying anew:
    additions have units of their own.
    """
    u_x, u_y, v = records[at + lay.U_X], records[at + lay.U_Y], records[at + lay.V]
    zero = np.float32(0.0)
    v_x, v_y, shift = (zero, v, 3) if v > zero else (v, zero, 0)
    store(state, steps, _block_steps() * u_x)
    store(state, steps + 8, _block_steps() * u_y)
    store(state, steps + 16, _block_steps() * v)
    state[steps + 24] = np.float32(4.0) * v_y
    dx = _lane_x() + (left - records[at + lay.MEAN_X])
    dy = _lane_y() + (top - records[at + lay.MEAN_Y])
    return splat(records[at + lay.LEVEL]), dx * u_x + dy * u_y, dx * v_x + dy * v_y, shift


@inlined
def offset(u0: Any, v0: Any, block: Any, part: int, state: Any, steps: int, shift: Any) -> Any:
    """(u, v) of the pixels of part of a block. Shifted, its number begins with its row if v goes
    by rows; else it is left as it is and begins with its column."""
    row = block >> 3
    u = u0 + state[steps + (block & 7)] + state[steps + 8 + row]
    v = v0 + state[steps + 16 + ((block >> shift) & 7)]
    if PARTS > 1:  # the second half is two pixels below
        u = u + state[steps + 9] * np.float32(0.5 * part)
        v = v + state[steps + 24] * np.float32(0.5 * part)
    return u, v
