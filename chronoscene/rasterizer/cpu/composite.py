"""Compositing, tile by tile, front to back; and how alpha is computed, for both passes.

What a pass keeps of a tile is ordered by block, so that a vector is one aligned load, and all that
belongs to a block lies together: planes a power of two apart would collide in the processor's
store buffer.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import prefetch, store, store_where
from chronoscene.kernels.thread_pool import draw
from chronoscene.kernels.transposes import store_pixels
from chronoscene.kernels.vector_math import ROUNDER, exp2
from chronoscene.kernels.vectors import (
    FUSED,
    any_lane,
    make_constant,
    minimum,
    multiply_add,
    select,
    trailing_zeros,
)
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.layout import LANES, PART_ROWS, PARTS, load, splat, splat_int

AHEAD = 12  # Entries by which records are asked for in advance
STEPS = 32  # Scratch numbers of a Gaussian in a tile, see `start_gaussian`
_STATE = 80  # Numbers per block: light, red, green, blue, depth
_STEPS = 64 * _STATE  # Where the steps are
FORWARD_NUMBERS = _STEPS + STEPS  # Scratch of one worker

_lane_x = make_constant([i % 4 + 0.5 for i in range(LANES)])
_lane_y = make_constant([i // 4 + 0.5 for i in range(LANES)])
_block_steps = make_constant([4.0 * i for i in range(8)])


@inlined
def gaussian_of(numbers: Any, entry: Any) -> Any:
    """The Gaussian of an entry."""
    return numbers[layout.ENTRY_NUMBERS * entry + layout.GAUSSIAN]


@inlined
def tile_corner(tile: Any, width: Any) -> Any:
    """Left and top pixel of a tile."""
    tiles_x = (width + layout.TILE - 1) // layout.TILE
    return layout.TILE * (tile % tiles_x), layout.TILE * (tile // tiles_x)


@inlined
def start_gaussian(records: Any, at: int, left: Any, top: Any, state: Any, steps: int) -> Any:
    """Level of a Gaussian, (u, v) of the pixels of a tile's first block, and `power_at`'s shift.

    (u, v) is the offset from the mean, whitened: u = U_X dx + U_Y dy, and v = V dy, or V dx where V
    is negative. How they change from block to block goes into numbers of ``state``: 8 of u by
    column, 8 of u by row, 8 of v by row or by column, 1 of v by row. Adding them costs less than
    multiplying anew: additions have units of their own.
    """
    u_x, u_y, v = records[at + layout.U_X], records[at + layout.U_Y], records[at + layout.V]
    zero = np.float32(0.0)
    v_x, v_y, shift = (zero, v, 3) if v > zero else (v, zero, 0)
    store(state, steps, _block_steps() * u_x)
    store(state, steps + 8, _block_steps() * u_y)
    store(state, steps + 16, _block_steps() * v)
    state[steps + 24] = np.float32(4.0) * v_y
    dx = _lane_x() + (left - records[at + layout.MEAN_X])
    dy = _lane_y() + (top - records[at + layout.MEAN_Y])
    return splat(records[at + layout.LEVEL]), dx * u_x + dy * u_y, dx * v_x + dy * v_y, shift


@inlined
def slopes(records: Any, at: int) -> Any:
    """Derivatives of u and v along x and y."""
    u_x, u_y, v = records[at + layout.U_X], records[at + layout.U_Y], records[at + layout.V]
    zero = np.float32(0.0)
    return (u_x, u_y, zero, v) if v > zero else (u_x, u_y, v, zero)


@inlined
def color_of(records: Any, at: int) -> Any:
    """Red, green and blue of a Gaussian."""
    color = at + layout.COLOR
    return splat(records[color]), splat(records[color + 1]), splat(records[color + 2])


@inlined
def power_at(gaussian: Any, block: Any, part: int, state: Any, steps: int) -> Any:
    """log2(alpha) = LEVEL - u^2 - v^2 before the cap, in the pixels of part of a block; u and v.

    Args:
        gaussian: From `start_gaussian`. Shifted, the number of a block begins with its row if v
            goes by rows; else it is left as it is and begins with its column.
    """
    level, u, v, shift = gaussian
    row = block >> 3
    u = u + state[steps + (block & 7)] + state[steps + 8 + row]
    v = v + state[steps + 16 + ((block >> shift) & 7)]
    if PARTS > 1:  # the second half is two pixels below
        u = u + state[steps + 9] * np.float32(0.5 * part)
        v = v + state[steps + 24] * np.float32(0.5 * part)
    rest = level - v * v
    return rest - u * u, u, v


@inner(fast_math=True)
def _start_tile(left, top, width, height, state, planes, plane, end):
    """Light everywhere but in pixels outside the image. Returns the blocks inside.

    No entry counts in the pixels outside: on the way back their light would else be divided by
    what passes each of the entries of their block, without an end.
    """
    transmittance, last = planes
    transmittance[plane : plane + layout.TILE_PIXELS] = np.float32(1.0)
    active = np.uint64(0)
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _STATE * block
        state[at + 16 : at + _STATE] = np.float32(0.0)
        kept = plane + 16 * block
        if x + 4 <= width and y + 4 <= height:
            state[at : at + 16] = np.float32(1.0)
            last[kept : kept + 16] = end
            active |= np.uint64(1) << np.uint64(block)
            continue
        state[at : at + 16] = np.float32(0.0)
        last[kept : kept + 16] = np.int32(-1)
        if x < width and y < height:
            active |= np.uint64(1) << np.uint64(block)
            for row in range(min(4, height - y)):
                for column in range(min(4, width - x)):
                    state[at + 4 * row + column] = np.float32(1.0)
                    last[kept + 4 * row + column] = end
    return active


@inner(fast_math=True)
def _any_light(state, at):
    """Return True if any pixel of a block is active."""
    found = False
    for part in range(PARTS):
        found |= any_lane(load(state, at + LANES * part) > 0.0)
    return found


@inlined
def _light_left(alpha: Any, light: Any) -> Any:
    """Return (1 - alpha) light, in one rounding or in two small ones.

    The rounding of light - alpha light is that of the light before, which may be 1000 times what is
    left.
    """
    if FUSED:
        return multiply_add(0.0 - alpha, light, light)
    return (1.0 - alpha) * light


@inner(fast_math=True)
def _forward_tile(depth, start, end, left, top, active, plane, entries, records, planes, state):
    """Composite the entries of a tile: C += alpha T c, T *= 1 - alpha. Returns where it stopped.

    The type of ``depth`` says if that is a channel, too.

    A finished pixel has light 0 here, so that nothing adds to it; what light it had is kept in the
    planes, with the entry before which it ended. That happens once per pixel: the branch is rare,
    and keeps the test out of the chain of dependent instructions. The blocks of each entry are cut
    down to those that were active, for the backward pass.
    """
    transmittance, last = planes
    blocks, numbers = entries
    for entry in range(start, end):
        bits = blocks[layout.ENTRY_BLOCKS * entry] & active
        blocks[layout.ENTRY_BLOCKS * entry] = bits
        prefetch(records, layout.RECORD * gaussian_of(numbers, entry + AHEAD))
        if bits == 0:
            if active == 0:
                return entry
            continue
        record = layout.RECORD * gaussian_of(numbers, entry)
        gaussian = start_gaussian(records, record, left, top, state, _STEPS)
        red, green, blue = color_of(records, record)
        z = splat(records[record + layout.DEPTH])
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(PARTS):
                at = _STATE * block + LANES * part
                power, _, _ = power_at(gaussian, block, part, state, _STEPS)
                alpha = minimum(exp2(power, power + ROUNDER), constants.ALPHA_MAX)
                counts = power >= layout.LEVEL_MIN
                light = load(state, at)
                weight = select(counts, alpha * light, 0.0)
                after = select(counts, _light_left(alpha, light), light)
                ending = (light > 0.0) & (after <= constants.TRANSMITTANCE_MIN)
                if any_lane(ending):
                    weight = select(ending, 0.0, weight)
                    after = select(ending, 0.0, after)
                    here = plane + 16 * block + LANES * part
                    store_where(transmittance, here, ending, light)
                    store_where(last, here, ending, splat_int(entry))
                    store(state, at, after)
                    if not _any_light(state, _STATE * block):
                        active &= ~(np.uint64(1) << np.uint64(block))
                store(state, at, after)
                store(state, at + 16, load(state, at + 16) + weight * red)
                store(state, at + 32, load(state, at + 32) + weight * green)
                store(state, at + 48, load(state, at + 48) + weight * blue)
                if len(depth) > 0:
                    store(state, at + 64, load(state, at + 64) + weight * z)
    return end


@inner(fast_math=True)
def _write_tile(
    left, top, width, height, plane, state, transmittance, background, image, alphas, depth
):
    """Image C + T b over the background b, opacity 1 - T, and depth, from a tile's state."""
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _STATE * block
        for part in range(PARTS):
            i, k = at + LANES * part, plane + 16 * block + LANES * part
            light, kept = load(state, i), load(transmittance, k)
            light = select(light > 0.0, light, kept)
            store(state, i, light)
            store(transmittance, k, light)
            store(state, i + 16, load(state, i + 16) + light * red)
            store(state, i + 32, load(state, i + 32) + light * green)
            store(state, i + 48, load(state, i + 48) + light * blue)
        if x + 4 <= width and y + 4 <= height:
            for part in range(PARTS):
                i, pixel = at + LANES * part, (y + PART_ROWS * part) * width + x
                channels = (load(state, i + 16), load(state, i + 32), load(state, i + 48))
                store_pixels(image, 3 * pixel, 3 * width, channels)
                store_pixels(alphas, pixel, width, (1.0 - load(state, i),))
                if len(depth) > 0:
                    store_pixels(depth[0], pixel, width, (load(state, i + 64),))
        else:
            for k in range(16):
                if x + k % 4 < width and y + k // 4 < height:
                    pixel = (y + k // 4) * width + x + k % 4
                    alphas[pixel] = np.float32(1.0) - state[at + k]
                    for c in range(3):
                        image[3 * pixel + c] = state[at + 16 + 16 * c + k]
                    if len(depth) > 0:
                        depth[0][pixel] = state[at + 64 + k]


@kernel(fast_math=True, extras=[constants])
def composite(
    worker, control, size, tiles, entries, records, planes, states, background, image, alphas, depth
):
    """Composite all tiles.

    Args:
        worker, control: See `thread_pool.launch`; a job is a tile.
        size: (width, height) of the image in pixels.
        tiles: (first entry of each tile and the end of the last, where compositing stopped, which
            is written, order in which to take the tiles). int64, int64, int32
        entries: As uint64 and as int32, see `layout`, readable a little past the end; blocks are
            cut down to those that were active.
        records: See `layout`.
        planes: (transmittance, end of the entries that count), by tile, written.
        states: Scratch, `FORWARD_NUMBERS` per worker.
        background: Three numbers.
        image, alphas: Written. [H * W * 3], [H * W]
        depth: A tuple: nothing, or where the depth times the opacity is written. [H * W]
    """
    width, height = size
    starts, stops, order = tiles
    state = states[worker]
    job = draw(control, 0)
    while job < stops.size:
        tile = order[job]
        left, top = tile_corner(tile, width)
        plane, start, end = layout.TILE_PIXELS * tile, starts[tile], starts[tile + 1]
        active = _start_tile(left, top, width, height, state, planes, plane, end)
        x, y = np.float32(left), np.float32(top)
        stops[tile] = _forward_tile(
            depth, start, end, x, y, active, plane, entries, records, planes, state
        )
        light = (background[0], background[1], background[2])
        _write_tile(left, top, width, height, plane, state, planes[0], light, image, alphas, depth)
        job = draw(control, 0)
