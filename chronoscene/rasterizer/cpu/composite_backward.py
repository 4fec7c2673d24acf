"""The gradient of compositing, tile by tile, back to front."""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

import numpy as np

from chronoscene.rasterizer.constants import ALPHA_MAX
from chronoscene.rasterizer.cpu import sizes as lay
from chronoscene.rasterizer.cpu.kernel import helper, kernel
from chronoscene.rasterizer.cpu.phases import draw
from chronoscene.rasterizer.cpu.simd import (
    LANES,
    as_float,
    as_int,
    load,
    load_pixels,
    minimum,
    prefetch,
    prefetch_write,
    select,
    splat,
    splat_int,
    store,
    store_sums,
    trailing_zeros,
)
from chronoscene.rasterizer.cpu.tile import AHEAD, PART_ROWS, PARTS, offset, whitened
from chronoscene.rasterizer.cpu.vecmath import ROUND, exp2

_PIXELS = lay.TILE_PIXELS
_STATE = 96  # numbers per block: light, behind, gradient of red, green, blue, end of what counts
_STEPS = 64 * _STATE  # where the numbers of `tile.whitened` are
BACKWARD_NUMBERS = _STEPS + 32
"""Scratch of one worker."""
_LEVEL_MIN = lay.LEVEL_MIN


@helper
def _start_backward(
    left, top, width, height, plane, planes, image_grad, alpha_grad, background, state
):
    """State of a tile: final light, the background behind it, gradients of the channels."""
    transmittance, last = planes
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _STATE * block
        if x >= width or y >= height:
            continue
        if x + 4 <= width and y + 4 <= height:
            for part in range(PARTS):
                i, pixel = at + LANES * part, (y + PART_ROWS * part) * width + x
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
        for part in range(PARTS):
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
        ahead = max(entry - AHEAD, 0)
        prefetch(records, lay.RECORD * gaussians[ahead])
        prefetch_write(rows, lay.RECORD * places[ahead])
        if bits == 0:
            continue
        record = lay.RECORD * gaussians[entry]
        level, u0, v0, shift = whitened(records, record, left, top, state, _STEPS)
        red, green = splat(records[record + lay.COLOR]), splat(records[record + lay.COLOR + 1])
        blue = splat(records[record + lay.COLOR + 2])
        s = su = sv = suu = suv = svv = sr = sg = sb = splat(np.float32(0.0))
        number = splat_int(entry)
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(PARTS):
                at = _STATE * block + LANES * part
                u, v = offset(u0, v0, block, part, state, _STEPS, shift)
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
        rows[lay.RECORD * place + lay.SUM_SIGN] = records[record + lay.V]


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
