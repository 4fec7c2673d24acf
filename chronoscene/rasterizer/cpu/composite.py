"""Compositing, tile by tile, front to back."""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

import numpy as np

from chronoscene.rasterizer.constants import ALPHA_MAX, TRANSMITTANCE_MIN
from chronoscene.rasterizer.cpu import sizes as lay
from chronoscene.rasterizer.cpu.kernel import helper, kernel
from chronoscene.rasterizer.cpu.phases import draw
from chronoscene.rasterizer.cpu.simd import (
    LANES,
    any_lane,
    load,
    minimum,
    multiply_add,
    prefetch,
    select,
    splat,
    splat_int,
    store,
    store_pixels,
    store_where,
    trailing_zeros,
)
from chronoscene.rasterizer.cpu.tile import AHEAD, PART_ROWS, PARTS, offset, whitened
from chronoscene.rasterizer.cpu.vecmath import ROUND, exp2

_PIXELS = lay.TILE_PIXELS
_STATE = 64  # numbers per block: light, red, green, blue
_STEPS = 64 * _STATE  # where the numbers of `tile.whitened` are
FORWARD_NUMBERS = _STEPS + 32
"""Scratch of one worker."""
_LEVEL_MIN = lay.LEVEL_MIN


@helper
def _start_tile(left, top, width, height, state, planes, plane, end):
    """Light everywhere, pixels outside the image dead. Returns the blocks inside."""
    transmittance, last = planes
    transmittance[plane : plane + _PIXELS] = np.float32(1.0)
    live = np.uint64(0)
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _STATE * block
        state[at + 16 : at + 64] = np.float32(0.0)
        last[plane + 16 * block : plane + 16 * block + 16] = end
        if x + 4 <= width and y + 4 <= height:
            state[at : at + 16] = np.float32(1.0)
            live |= np.uint64(1) << np.uint64(block)
            continue
        state[at : at + 16] = np.float32(0.0)
        if x < width and y < height:
            live |= np.uint64(1) << np.uint64(block)
            for row in range(min(4, height - y)):
                for column in range(min(4, width - x)):
                    state[at + 4 * row + column] = np.float32(1.0)
    return live


@helper
def _any_light(state, at):
    """Whether any pixel of a block is alive."""
    alive = False
    for part in range(PARTS):
        alive |= any_lane(load(state, at + LANES * part) > 0.0)
    return alive


@helper
def _forward_tile(start, end, left, top, live, plane, gaussians, blocks, records, planes, state):
    """Composite the entries of a tile. Returns where it stopped.

    A dead pixel has light 0 here, so that nothing adds to it; what light it had is kept in the
    planes, with the entry before which it ended. That happens once per pixel: the branch is rare,
    and keeps the test out of the chain of dependent instructions. The blocks of each entry are cut
    down to those that were alive, for the backward pass.
    """
    transmittance, last = planes
    for entry in range(start, end):
        bits = blocks[entry] & live
        blocks[entry] = bits
        prefetch(records, lay.RECORD * gaussians[entry + AHEAD])
        if bits == 0:
            if live == 0:
                return entry
            continue
        record = lay.RECORD * gaussians[entry]
        level, u0, v0, shift = whitened(records, record, left, top, state, _STEPS)
        red, green = splat(records[record + lay.COLOR]), splat(records[record + lay.COLOR + 1])
        blue = splat(records[record + lay.COLOR + 2])
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(PARTS):
                at = _STATE * block + LANES * part
                u, v = offset(u0, v0, block, part, state, _STEPS, shift)
                rest = level - v * v
                power = rest - u * u
                alpha = minimum(exp2(power, power + ROUND), ALPHA_MAX)
                counts = power >= _LEVEL_MIN
                light = load(state, at)
                weight = select(counts, alpha * light, 0.0)
                # Not light - weight: its rounding is that of the light before, which may be 1000
                # times what is left.
                after = select(counts, multiply_add(0.0 - alpha, light, light), light)
                dying = (light > 0.0) & (after <= TRANSMITTANCE_MIN)
                if any_lane(dying):
                    weight = select(dying, 0.0, weight)
                    after = select(dying, 0.0, after)
                    here = plane + 16 * block + LANES * part
                    store_where(transmittance, here, dying, light)
                    store_where(last, here, dying, splat_int(entry))
                    store(state, at, after)
                    if not _any_light(state, _STATE * block):
                        live &= ~(np.uint64(1) << np.uint64(block))
                store(state, at, after)
                store(state, at + 16, load(state, at + 16) + weight * red)
                store(state, at + 32, load(state, at + 32) + weight * green)
                store(state, at + 48, load(state, at + 48) + weight * blue)
    return end


@helper
def _write_tile(left, top, width, height, plane, state, transmittance, background, image, alphas):
    """Colours over the background, and opacity, from a tile's state to the image."""
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _STATE * block
        for part in range(PARTS):
            i = at + LANES * part
            light, kept = (
                load(state, i),
                load(transmittance, plane + 16 * block + LANES * part),
            )
            light = select(light > 0.0, light, kept)
            store(state, i, light)
            store(transmittance, plane + 16 * block + LANES * part, light)
            store(state, i + 16, load(state, i + 16) + light * red)
            store(state, i + 32, load(state, i + 32) + light * green)
            store(state, i + 48, load(state, i + 48) + light * blue)
        if x + 4 <= width and y + 4 <= height:
            for part in range(PARTS):
                i, pixel = at + LANES * part, (y + PART_ROWS * part) * width + x
                store_pixels(
                    image,
                    3 * pixel,
                    3 * width,
                    (load(state, i + 16), load(state, i + 32), load(state, i + 48)),
                )
                store_pixels(alphas, pixel, width, (1.0 - load(state, i),))
        else:
            for k in range(16):
                if x + k % 4 < width and y + k // 4 < height:
                    pixel = (y + k // 4) * width + x + k % 4
                    alphas[pixel] = np.float32(1.0) - state[at + k]
                    for c in range(3):
                        image[3 * pixel + c] = state[at + 16 + 16 * c + k]


@kernel
def composite(
    worker,
    control,
    width,
    height,
    tile_starts,
    tile_stops,
    tile_order,
    gaussians,
    blocks,
    records,
    planes,
    states,
    background,
    image,
    alphas,
):
    """Composite all tiles.

    Args:
        worker, control: See `team.launch`; a job is a tile.
        width, height: Of the image in pixels.
        tile_starts: First entry of each tile, and the end of the last. int64 [tiles + 1]
        tile_stops: Written: where compositing stopped. int64 [tiles]
        tile_order: Order in which to take the tiles. int32 [tiles]
        gaussians: Gaussian of each entry, readable a little past the end. int32
        blocks: Blocks of each entry; cut down to those that were alive. uint64
        records: See `layout`.
        planes: (transmittance, end of the entries that count), by tile, written.
        states: Scratch, `FORWARD_NUMBERS` per worker.
        background: Three numbers.
        image, alphas: Written. [H * W * 3], [H * W]
    """
    tiles_x = (width + lay.TILE - 1) // lay.TILE
    tiles = tile_stops.size
    transmittance, _ = planes
    state = states[worker]
    job = draw(control, 0)
    while job < tiles:
        tile = tile_order[job]
        left, top = lay.TILE * (tile % tiles_x), lay.TILE * (tile // tiles_x)
        plane, start, end = _PIXELS * tile, tile_starts[tile], tile_starts[tile + 1]
        live = _start_tile(left, top, width, height, state, planes, plane, end)
        tile_stops[tile] = _forward_tile(
            start,
            end,
            np.float32(left),
            np.float32(top),
            live,
            plane,
            gaussians,
            blocks,
            records,
            planes,
            state,
        )
        _write_tile(
            left,
            top,
            width,
            height,
            plane,
            state,
            transmittance,
            (background[0], background[1], background[2]),
            image,
            alphas,
        )
        job = draw(control, 0)
