"""The gradient of compositing, tile by tile, back to front."""

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import prefetch, prefetch_write, store
from chronoscene.kernels.thread_pool import draw
from chronoscene.kernels.transposes import make_load_pixels, store_sums
from chronoscene.kernels.vector_math import ROUNDER, exp2
from chronoscene.kernels.vectors import absolute, as_float, as_int, minimum, select, trailing_zeros
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.composite import (
    AHEAD,
    STEPS,
    color_of,
    gaussian_of,
    power_at,
    slopes,
    start_gaussian,
    tile_corner,
)
from chronoscene.rasterizer.cpu.layout import LANES, PART_ROWS, PARTS, load, splat, splat_int

# Numbers per block: light, behind, gradients of red, green, blue, the end of what counts, gradient
# of the depth.
_STATE = 112
_STEPS = 64 * _STATE  # Where the steps are
BACKWARD_NUMBERS = _STEPS + STEPS  # Scratch of one worker

_load_rgb, _load_plane = make_load_pixels(3, LANES), make_load_pixels(1, LANES)


@inlined
def _place_of(numbers: Any, entry: Any) -> Any:
    """The row of sums of an entry."""
    return numbers[layout.ENTRY_NUMBERS * entry + layout.PLACE]


@inner(fast_math=True)
def _start_backward(left, top, width, height, plane, planes, grads, depth_grad, background, state):
    """State of a tile: final light, gradients g of the channels, and what is behind the last
    Gaussian, B = b . g - d loss / d opacity with b the background."""
    transmittance, last = planes
    image_grad, alpha_grad = grads
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        at = _STATE * block
        if x >= width or y >= height:
            continue
        if x + 4 <= width and y + 4 <= height:
            for part in range(PARTS):
                i, pixel = at + LANES * part, (y + PART_ROWS * part) * width + x
                r, g, b = _load_rgb(image_grad, 3 * pixel, 3 * width)
                store(state, i + 32, r)
                store(state, i + 48, g)
                store(state, i + 64, b)
                behind = r * red + (g * green + b * blue)
                if alpha_grad.size > 0:
                    behind = behind - _load_plane(alpha_grad, pixel, width)[0]
                store(state, i + 16, behind)
                if len(depth_grad) > 0:
                    store(state, i + 96, _load_plane(depth_grad[0], pixel, width)[0])
        else:
            for k in range(16):
                r = g = b = a = z = np.float32(0.0)
                if x + k % 4 < width and y + k // 4 < height:
                    pixel = (y + k // 4) * width + x + k % 4
                    r, g = image_grad[3 * pixel], image_grad[3 * pixel + 1]
                    b = image_grad[3 * pixel + 2]
                    if alpha_grad.size > 0:
                        a = alpha_grad[pixel]
                    if len(depth_grad) > 0:
                        z = depth_grad[0][pixel]
                state[at + 32 + k], state[at + 48 + k], state[at + 64 + k] = r, g, b
                state[at + 16 + k] = r * red + g * green + b * blue - a
                state[at + 96 + k] = z
        for part in range(PARTS):
            i, k = at + LANES * part, plane + 16 * block + LANES * part
            store(state, i, load(transmittance, k))
            store(state, i + 80, as_float(load(last, k)))


@inner(fast_math=True)
def _backward_tile(
    absgrad, depth_grad, start, stop, left, top, entries, records, touched, rows, state
):
    """Rows of the entries of a tile, from the last to the first.

    With T the light before a Gaussian and B the gradient-weighted colour behind it as seen with
    unit light: d loss / d alpha = T (c . grad - B); behind the next one in front,
    B' = B + alpha (c . grad - B). The types of ``absgrad`` and ``depth_grad`` say what is compiled.
    """
    blocks, numbers = entries
    for k in range(stop - start):
        entry = stop - 1 - k
        bits = blocks[layout.ENTRY_BLOCKS * entry]
        ahead = max(entry - AHEAD, 0)
        prefetch(records, layout.RECORD * gaussian_of(numbers, ahead))
        prefetch_write(rows, layout.RECORD * _place_of(numbers, ahead))
        if bits == 0:
            continue
        record = layout.RECORD * gaussian_of(numbers, entry)
        gaussian = start_gaussian(records, record, left, top, state, _STEPS)
        red, green, blue = color_of(records, record)
        z = splat(records[record + layout.DEPTH])
        s = su = sv = suu = suv = svv = sr = sg = sb = sz = splat(np.float32(0.0))
        sx, sy, slope = s, s, slopes(records, record)
        number = splat_int(entry)
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(PARTS):
                at = _STATE * block + LANES * part
                power, u, v = power_at(gaussian, block, part, state, _STEPS)
                raw = exp2(power, power + ROUNDER)
                counts = (power >= layout.LEVEL_MIN) & (number < as_int(load(state, at + 80)))
                alpha = select(counts, minimum(raw, constants.ALPHA_MAX), 0.0)
                # T = T_after / (1 - alpha).
                light = load(state, at) / (1.0 - alpha)
                behind = load(state, at + 16)
                gr, gg, gb = load(state, at + 32), load(state, at + 48), load(state, at + 64)
                difference = gr * red + (gg * green + (gb * blue - behind))
                if len(depth_grad) > 0:
                    gz = load(state, at + 96)
                    difference = difference + gz * z
                weight = alpha * light
                step = alpha * difference
                store(state, at, light)
                store(state, at + 16, step + behind)
                # d loss / d c = alpha T grad.
                sr = sr + weight * gr
                sg = sg + weight * gg
                sb = sb + weight * gb
                if len(depth_grad) > 0:
                    sz = sz + weight * gz
                # g = alpha d loss / d alpha, 0 where alpha is capped; its moments in (u, v).
                g = select(raw <= constants.ALPHA_MAX, step * light, 0.0)
                gu, gv = g * u, g * v
                s = s + g
                su = su + gu
                sv = sv + gv
                suu = suu + gu * u
                suv = suv + gu * v
                svv = svv + gv * v
                if len(absgrad) > 0:
                    sx = sx + absolute(gu * slope[0] + gv * slope[2])
                    sy = sy + absolute(gu * slope[1] + gv * slope[3])
        place = _place_of(numbers, entry)
        touched[place] = 1
        store_sums(rows, layout.RECORD * place, (s, su, sv, suu, suv, svv, sr, sg, sb, sz))
        rows[layout.RECORD * place + layout.SUM_SIGN] = records[record + layout.V]
        if len(absgrad) > 0:
            store_sums(state, _STEPS, (sx, sy))
            rows[layout.RECORD * place + layout.SUM_ABSOLUTE] = state[_STEPS]
            rows[layout.RECORD * place + layout.SUM_ABSOLUTE + 1] = state[_STEPS + 1]


@kernel(fast_math=True, extras=[constants])
def composite_backward(
    worker,
    control,
    size,
    tiles,
    entries,
    records,
    planes,
    states,
    background,
    grads,
    depth_grad,
    absgrad,
    out,
):
    """Sums over pixels of every entry, from the gradients of image, opacity and depth.

    Args:
        worker, control, size, background: As in `composite`.
        tiles, entries, records, planes: As `composite` left them.
        states: Scratch, `BACKWARD_NUMBERS` per worker.
        grads: Of image and opacity. [H * W * 3], [H * W] or nothing
        depth_grad: A tuple: nothing, or the gradient of the depth times the opacity. [H * W]
        absgrad: A tuple; unless it is empty, rows have absolute gradients too.
        out: (touched, rows), written. Where touched, zeros at first, becomes 1, there is a row of
            16 numbers, see `layout`. uint8, float32
    """
    width, height = size
    starts, stops, order = tiles
    touched, rows = out
    state = states[worker]
    job = draw(control, 0)
    while job < stops.size:
        tile = order[job]
        left, top = tile_corner(tile, width)
        plane, light = layout.TILE_PIXELS * tile, (background[0], background[1], background[2])
        _start_backward(left, top, width, height, plane, planes, grads, depth_grad, light, state)
        x, y = np.float32(left), np.float32(top)
        first, last = starts[tile], stops[tile]
        _backward_tile(
            absgrad, depth_grad, first, last, x, y, entries, records, touched, rows, state
        )
        job = draw(control, 0)
