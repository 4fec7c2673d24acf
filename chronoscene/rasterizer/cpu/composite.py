"""Compositing of one tile after the other, front to back, and its gradient, back to front.

A vector holds the pixels of one block (half of one where vectors are narrow). Pixel planes of a
tile are ordered by block, so that a vector is one aligned load.
"""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.rasterizer.constants import ALPHA_MAX, TRANSMITTANCE_MIN
from chronoscene.rasterizer.cpu import layout as lay
from chronoscene.rasterizer.cpu.kernel import helper, inlined, kernel
from chronoscene.rasterizer.cpu.phases import draw
from chronoscene.rasterizer.cpu.simd import (
    LANES,
    any_lane,
    as_float,
    as_int,
    load,
    load_pixels,
    make_constant,
    minimum,
    prefetch,
    prefetch_write,
    select,
    splat,
    splat_int,
    store,
    store_pixels,
    store_sums,
    store_where,
    trailing_zeros,
)
from chronoscene.rasterizer.cpu.vecmath import ROUND, exp2

_AHEAD = 6  # entries by which records are asked for in advance
_PARTS = 16 // LANES  # vectors per block
_PART_ROWS = LANES // 4
_PIXELS = lay.TILE_PIXELS
_STATE = 64  # numbers per block going forward: light, red, green, blue
_BACK = 96  # going backward: light, behind, gradient of red, green, blue, end of what counts
_STEPS, _BACK_STEPS = 64 * _STATE, 64 * _BACK  # where the 24 numbers of `_whitened` are
FORWARD_NUMBERS, BACKWARD_NUMBERS = _STEPS + 32, _BACK_STEPS + 32
"""Scratch of one worker."""
_LEVEL_MIN = lay.LEVEL_MIN

_lane_x = make_constant([i % 4 + 0.5 for i in range(LANES)])
_lane_y = make_constant([i // 4 + 0.5 for i in range(LANES)])
_block_steps = make_constant([4.0 * i for i in range(8)])


@inlined
def _whitened(records: Any, at: int, left: Any, top: Any, state: Any, steps: int) -> Any:
    """Level of a Gaussian, and (u, v) of the pixels of a tile's first block.

    How u and v change from block to block goes into 24 numbers of ``state``: u by column, u by
    row, v by row. Adding them costs less than multiplying anew: additions have units of their own.
    """
    axis_xx, axis_xy, axis_yy = records[at + 2], records[at + 3], records[at + 4]
    store(state, steps, _block_steps() * axis_xx)
    store(state, steps + 8, _block_steps() * axis_xy)
    store(state, steps + 16, _block_steps() * axis_yy)
    dx = _lane_x() + (left - records[at])
    dy = _lane_y() + (top - records[at + 1])
    return splat(records[at + 5]), dx * axis_xx + dy * axis_xy, dy * axis_yy


@inlined
def _offset(u0: Any, v0: Any, block: Any, part: int, state: Any, steps: int) -> Any:
    """(u, v) of the pixels of part of a block."""
    row = block >> 3
    u = u0 + state[steps + (block & 7)] + state[steps + 8 + row]
    v = v0 + state[steps + 16 + row]
    if _PARTS > 1:  # the second half is two pixels below
        u = u + state[steps + 9] * np.float32(0.5 * part)
        v = v + state[steps + 17] * np.float32(0.5 * part)
    return u, v


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
    for part in range(_PARTS):
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
        prefetch(records, lay.RECORD * gaussians[entry + _AHEAD])
        if bits == 0:
            if live == 0:
                return entry
            continue
        record = lay.RECORD * gaussians[entry]
        level, u0, v0 = _whitened(records, record, left, top, state, _STEPS)
        red, green = splat(records[record + 6]), splat(records[record + 7])
        blue = splat(records[record + 8])
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(_PARTS):
                at = _STATE * block + LANES * part
                u, v = _offset(u0, v0, block, part, state, _STEPS)
                rest = level - v * v
                power = rest - u * u
                alpha = minimum(exp2(power, power + ROUND), ALPHA_MAX)
                light = load(state, at)
                weight = select(power >= _LEVEL_MIN, alpha * light, 0.0)
                after = light - weight
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
        for part in range(_PARTS):
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
            for part in range(_PARTS):
                i, pixel = at + LANES * part, (y + _PART_ROWS * part) * width + x
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


@helper
def _start_backward(
    left, top, width, height, plane, planes, image_grad, alpha_grad, background, state
):
    """State of a tile: final light, the background behind it, gradients of the channels."""
    transmittance, last = planes
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _BACK * block
        if x >= width or y >= height:
            continue
        if x + 4 <= width and y + 4 <= height:
            for part in range(_PARTS):
                i, pixel = at + LANES * part, (y + _PART_ROWS * part) * width + x
                r, g, b = load_pixels(image_grad, 3 * pixel, 3 * width, 3)
                store(state, i + 32, r)
                store(state, i + 48, g)
                store(state, i + 64, b)
                behind = r * red + (g * green + b * blue)
                if alpha_grad.size > 0:
                    behind = behind - load_pixels(alpha_grad, pixel, width, 1)[0]
                store(state, i + 16, behind)
        else:
            for k in range(16):
                r = g = b = a = np.float32(0.0)
                if x + k % 4 < width and y + k // 4 < height:
                    pixel = (y + k // 4) * width + x + k % 4
                    r, g = image_grad[3 * pixel], image_grad[3 * pixel + 1]
                    b = image_grad[3 * pixel + 2]
                    if alpha_grad.size > 0:
                        a = alpha_grad[pixel]
                state[at + 32 + k], state[at + 48 + k], state[at + 64 + k] = r, g, b
                state[at + 16 + k] = r * red + g * green + b * blue - a
        for part in range(_PARTS):
            i, k = at + LANES * part, plane + 16 * block + LANES * part
            store(state, i, load(transmittance, k))
            store(state, i + 80, as_float(load(last, k)))


@helper
def _backward_tile(start, stop, left, top, entries, records, touched, rows, state):
    """Rows of the entries of a tile, from the last to the first.

    With T the light before a Gaussian and B the gradient-weighted colour behind it as seen with
    unit light: d loss / d alpha = T (c . grad - B); behind the next one in front,
    B' = B + alpha (c . grad - B).
    """
    gaussians, blocks, places = entries
    for k in range(stop - start):
        entry = stop - 1 - k
        bits = blocks[entry]
        ahead = max(entry - _AHEAD, 0)
        prefetch(records, lay.RECORD * gaussians[ahead])
        prefetch_write(rows, lay.RECORD * places[ahead])
        if bits == 0:
            continue
        record = lay.RECORD * gaussians[entry]
        level, u0, v0 = _whitened(records, record, left, top, state, _BACK_STEPS)
        red, green = splat(records[record + 6]), splat(records[record + 7])
        blue = splat(records[record + 8])
        s = su = sv = suu = suv = svv = sr = sg = sb = splat(np.float32(0.0))
        number = splat_int(entry)
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(_PARTS):
                at = _BACK * block + LANES * part
                u, v = _offset(u0, v0, block, part, state, _BACK_STEPS)
                rest = level - v * v
                power = rest - u * u
                raw = exp2(power, power + ROUND)
                counts = (power >= _LEVEL_MIN) & (number < as_int(load(state, at + 80)))
                alpha = select(counts, minimum(raw, ALPHA_MAX), 0.0)
                light = load(state, at) / (1.0 - alpha)
                behind = load(state, at + 16)
                gr, gg, gb = (
                    load(state, at + 32),
                    load(state, at + 48),
                    load(state, at + 64),
                )
                difference = gr * red + (gg * green + (gb * blue - behind))
                weight = alpha * light
                step = alpha * difference
                store(state, at, light)
                store(state, at + 16, step + behind)
                sr = sr + weight * gr
                sg = sg + weight * gg
                sb = sb + weight * gb
                g = select(raw <= ALPHA_MAX, step * light, 0.0)
                gu, gv = g * u, g * v
                s = s + g
                su = su + gu
                sv = sv + gv
                suu = suu + gu * u
                suv = suv + gu * v
                svv = svv + gv * v
        place = places[entry]
        touched[place] = 1
        store_sums(rows, lay.RECORD * place, (s, su, sv, suu, suv, svv, sr, sg, sb))


@kernel
def composite_backward(
    worker,
    control,
    width,
    height,
    tile_starts,
    tile_stops,
    tile_order,
    entries,
    records,
    planes,
    states,
    background,
    image_grad,
    alpha_grad,
    touched,
    rows,
):
    """Sums over pixels of every entry, from the gradients of image and opacity.

    Args:
        worker, control, width, height: As in `composite`.
        tile_starts, tile_stops, tile_order: As `composite` left them.
        entries: (gaussian, blocks, place of its row) of each entry; as `composite` left them.
        records, planes: As `composite` left them.
        states: Scratch, `BACKWARD_NUMBERS` per worker.
        background: Three numbers.
        image_grad, alpha_grad: [H * W * 3], [H * W] or nothing
        touched: Zeros; 1 is written where a row is. uint8
        rows: Written, 16 numbers per entry; see `layout`.
    """
    tiles_x = (width + lay.TILE - 1) // lay.TILE
    tiles = tile_stops.size
    state = states[worker]
    job = draw(control, 0)
    while job < tiles:
        tile = tile_order[job]
        left, top = lay.TILE * (tile % tiles_x), lay.TILE * (tile // tiles_x)
        start, stop = tile_starts[tile], tile_stops[tile]
        _start_backward(
            left,
            top,
            width,
            height,
            _PIXELS * tile,
            planes,
            image_grad,
            alpha_grad,
            (background[0], background[1], background[2]),
            state,
        )
        _backward_tile(
            start,
            stop,
            np.float32(left),
            np.float32(top),
            entries,
            records,
            touched,
            rows,
            state,
        )
        job = draw(control, 0)
