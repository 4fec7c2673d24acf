"""Compositing of one tile after the other, front to back, and its gradient, back to front.

A vector holds the pixels of one block (half of one where vectors are narrow). Pixel planes of a
tile are ordered by block, so that a vector is one aligned load.
"""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange

from chronoscene.rasterizer.constants import ALPHA_MAX, TRANSMITTANCE_MIN
from chronoscene.rasterizer.cpu import layout as lay
from chronoscene.rasterizer.cpu.simd import (
    FLAGS,
    LANES,
    any_lane,
    fetch_add,
    load,
    make_constant,
    minimum,
    prefetch,
    select,
    splat,
    splat_int,
    store,
    store_pixels,
    store_sums,
    store_where,
    trailing_zeros,
)
from chronoscene.rasterizer.cpu.vecmath import exp2

_FAST = set(FLAGS)
_AHEAD = 6  # entries by which records are asked for in advance
_PARTS = 16 // LANES  # vectors per block
_PART_ROWS = LANES // 4
_PIXELS = lay.TILE_PIXELS
_LEVEL_MIN = lay.LEVEL_MIN

_lane_x = make_constant([i % 4 + 0.5 for i in range(LANES)])
_lane_y = make_constant([i // 4 + 0.5 for i in range(LANES)])
_BLOCK_X = np.array([4.0 * (b % 8) for b in range(64)], dtype=np.float32)
_BLOCK_Y = np.array([4.0 * (b // 8) for b in range(64)], dtype=np.float32)


@njit(forceinline=True, fastmath=_FAST)
def _whitened(records: Any, at: int, left: Any, top: Any) -> Any:
    """Axes of a Gaussian and (u, v) of the lanes of a tile's first block."""
    axis_xx, axis_xy = splat(records[at + 2]), splat(records[at + 3])
    axis_yy, level = splat(records[at + 4]), splat(records[at + 5])
    dx = _lane_x() + (left - records[at])
    dy = _lane_y() + (top - records[at + 1])
    return axis_xx, axis_xy, axis_yy, level, axis_xx * dx + axis_xy * dy, axis_yy * dy


@njit(nogil=True, fastmath=_FAST)
def _start_tile(left, top, width, height, transmittance, last, at, end):
    """Light everywhere, pixels outside the image dead. Returns the blocks inside."""
    live = np.uint64(0)
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        if x < width and y < height:
            live |= np.uint64(1) << np.uint64(block)
        for i in range(16):
            inside = x + i % 4 < width and y + i // 4 < height
            transmittance[at + 16 * block + i] = np.float32(1.0 if inside else -1.0)
            last[at + 16 * block + i] = end
    return live


@njit(nogil=True, fastmath=_FAST)
def _any_light(transmittance, at):
    """Whether any pixel of a block is alive."""
    best = np.float32(0.0)
    for i in range(16):
        best = max(best, transmittance[at + i])
    return best > 0.0


@njit(nogil=True, fastmath=_FAST)
def _forward_tile(start, end, left, top, live, plane, gaussians, blocks, records, planes, colors):
    """Composite the entries of a tile. Returns where it stopped.

    Dead pixels are marked by a negative transmittance. The blocks of each entry are cut down to
    those that were alive, for the backward pass.
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
        at = lay.RECORD * gaussians[entry]
        axis_xx, axis_xy, axis_yy, level, u0, v0 = _whitened(records, at, left, top)
        red, green, blue = splat(records[at + 6]), splat(records[at + 7]), splat(records[at + 8])
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(_PARTS):
                i = 16 * block + LANES * part
                y = _BLOCK_Y[block] + np.float32(_PART_ROWS * part)
                u = axis_xx * _BLOCK_X[block] + (axis_xy * y + u0)
                v = axis_yy * y + v0
                power = level - v * v - u * u
                alpha = minimum(exp2(power), ALPHA_MAX)
                light = load(transmittance, plane + i)
                weight = select(power >= _LEVEL_MIN, alpha * light, 0.0)
                after = light - weight
                alive = after > TRANSMITTANCE_MIN
                weight = select(alive, weight, 0.0)
                store(colors, i, load(colors, i) + weight * red)
                store(colors, _PIXELS + i, load(colors, _PIXELS + i) + weight * green)
                store(colors, 2 * _PIXELS + i, load(colors, 2 * _PIXELS + i) + weight * blue)
                dying = (light > 0.0) & (after <= TRANSMITTANCE_MIN)
                light_after = select(alive, after, light)
                store(transmittance, plane + i, light_after)
                if any_lane(dying):
                    store(transmittance, plane + i, select(dying, 0.0 - light, light_after))
                    store_where(last, plane + i, dying, splat_int(entry))
                    if not _any_light(transmittance, plane + 16 * block):
                        live &= ~(np.uint64(1) << np.uint64(block))
    return end


@njit(nogil=True, fastmath=_FAST)
def _write_tile(left, top, width, height, plane, transmittance, colors, background, image, alphas):
    """Colours over the background, and opacity, from planes to the image."""
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        if x >= width or y >= height:
            continue
        i = 16 * block
        if x + 4 <= width and y + 4 <= height:
            for part in range(_PARTS):
                k = i + LANES * part
                raw = load(transmittance, plane + k)
                light = select(raw < 0.0, 0.0 - raw, raw)
                store_pixels(
                    image,
                    3 * ((y + _PART_ROWS * part) * width + x),
                    3 * width,
                    load(colors, k) + light * red,
                    load(colors, _PIXELS + k) + light * green,
                    load(colors, 2 * _PIXELS + k) + light * blue,
                )
        for k in range(16):
            px, py = x + k % 4, y + k // 4
            if px < width and py < height:
                light = abs(transmittance[plane + i + k])
                pixel = py * width + px
                alphas[pixel] = np.float32(1.0) - light
                image[3 * pixel] = colors[i + k] + light * red
                image[3 * pixel + 1] = colors[_PIXELS + i + k] + light * green
                image[3 * pixel + 2] = colors[2 * _PIXELS + i + k] + light * blue


@njit(nogil=True, parallel=True, cache=True, fastmath=_FAST)
def composite(
    threads,
    counter,
    width,
    height,
    tile_starts,
    tile_stops,
    gaussians,
    blocks,
    records,
    planes,
    colors,
    background,
    image,
    alphas,
):
    """Composite all tiles.

    Args:
        threads, counter: As in `project.project`; workers take tiles.
        width, height: Of the image in pixels.
        tile_starts: First entry of each tile, and the end of the last. int64 [tiles + 1]
        tile_stops: Written: where compositing stopped. int64 [tiles]
        gaussians: Gaussian of each entry, readable a little past the end. int32
        blocks: Blocks of each entry; cut down to those that were alive. uint64
        records: See `layout`.
        planes: (transmittance, end of the entries that count), by tile, written.
        colors: Scratch, 3 planes of one tile per thread.
        background: Three numbers.
        image, alphas: Written. [H * W * 3], [H * W]
    """
    tiles_x = (width + lay.TILE - 1) // lay.TILE
    tiles = tile_stops.size
    transmittance, last = planes
    for t in prange(threads):
        scratch = colors[t]
        while True:
            tile = fetch_add(counter, 1)
            if tile >= tiles:
                break
            left, top = lay.TILE * (tile % tiles_x), lay.TILE * (tile // tiles_x)
            plane, start, end = _PIXELS * tile, tile_starts[tile], tile_starts[tile + 1]
            scratch[:] = np.float32(0.0)
            live = _start_tile(left, top, width, height, transmittance, last, plane, end)
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
                scratch,
            )
            _write_tile(
                left,
                top,
                width,
                height,
                plane,
                transmittance,
                scratch,
                (background[0], background[1], background[2]),
                image,
                alphas,
            )


@njit(nogil=True, fastmath=_FAST)
def _start_backward(
    left, top, width, height, plane, transmittance, image_grad, alpha_grad, background, scratch
):
    """Planes of a tile: light, what lies behind, and the three channels of the gradient."""
    red, green, blue = background
    for block in range(64):
        x, y = left + 4 * (block % 8), top + 4 * (block // 8)
        for k in range(16):
            i = 16 * block + k
            px, py = x + k % 4, y + k // 4
            r = g = b = behind = np.float32(0.0)
            if px < width and py < height:
                pixel = py * width + px
                r, g, b = (
                    image_grad[3 * pixel],
                    image_grad[3 * pixel + 1],
                    image_grad[3 * pixel + 2],
                )
                behind = red * r + green * g + blue * b - alpha_grad[pixel]
            scratch[i] = abs(transmittance[plane + i])
            scratch[_PIXELS + i] = behind
            scratch[2 * _PIXELS + i] = r
            scratch[3 * _PIXELS + i] = g
            scratch[4 * _PIXELS + i] = b


@njit(nogil=True, fastmath=_FAST)
def _backward_tile(
    start, stop, left, top, plane, gaussians, blocks, records, last, touched, rows, scratch
):
    """Rows of the entries of a tile, from the last to the first.

    With T the light before a Gaussian and B the gradient-weighted colour behind it as seen with
    unit light: d loss / d alpha = T (c . grad - B); behind the next one in front,
    B' = B + alpha (c . grad - B).
    """
    for k in range(stop - start):
        entry = stop - 1 - k
        bits = blocks[entry]
        touched[entry] = bits != 0
        prefetch(records, lay.RECORD * gaussians[max(entry - _AHEAD, 0)])
        if bits == 0:
            continue
        at = lay.RECORD * gaussians[entry]
        axis_xx, axis_xy, axis_yy, level, u0, v0 = _whitened(records, at, left, top)
        red, green, blue = splat(records[at + 6]), splat(records[at + 7]), splat(records[at + 8])
        s = su = sv = suu = suv = svv = sr = sg = sb = splat(np.float32(0.0))
        number = splat_int(entry)
        while bits != 0:
            block = trailing_zeros(bits)
            bits &= bits - np.uint64(1)
            for part in range(_PARTS):
                i = 16 * block + LANES * part
                y = _BLOCK_Y[block] + np.float32(_PART_ROWS * part)
                u = axis_xx * _BLOCK_X[block] + (axis_xy * y + u0)
                v = axis_yy * y + v0
                power = level - v * v - u * u
                raw = exp2(power)
                counts = (power >= _LEVEL_MIN) & (number < load(last, plane + i))
                alpha = select(counts, minimum(raw, ALPHA_MAX), 0.0)
                light = load(scratch, i) / (1.0 - alpha)
                behind = load(scratch, _PIXELS + i)
                gr, gg = load(scratch, 2 * _PIXELS + i), load(scratch, 3 * _PIXELS + i)
                gb = load(scratch, 4 * _PIXELS + i)
                difference = gr * red + (gg * green + (gb * blue - behind))
                weight = alpha * light
                store(scratch, i, light)
                store(scratch, _PIXELS + i, alpha * difference + behind)
                sr = sr + weight * gr
                sg = sg + weight * gg
                sb = sb + weight * gb
                g = select(raw <= ALPHA_MAX, weight * difference, 0.0)
                gu, gv = g * u, g * v
                s = s + g
                su = su + gu
                sv = sv + gv
                suu = suu + gu * u
                suv = suv + gu * v
                svv = svv + gv * v
        store_sums(rows, lay.RECORD * entry, (s, su, sv, suu, suv, svv, sr, sg, sb))


@njit(nogil=True, parallel=True, cache=True, fastmath=_FAST)
def composite_backward(
    threads,
    counter,
    width,
    height,
    tile_starts,
    tile_stops,
    gaussians,
    blocks,
    records,
    planes,
    scratch,
    background,
    image_grad,
    alpha_grad,
    touched,
    rows,
):
    """Sums over pixels of every entry, from the gradients of image and opacity.

    Args:
        threads .. planes: As `composite` left them.
        scratch: 5 planes of one tile per thread.
        background: Three numbers.
        image_grad, alpha_grad: [H * W * 3], [H * W]
        touched: Written: whether the entry's row was written. uint8
        rows: Written, 16 numbers per entry; see `layout`.
    """
    tiles_x = (width + lay.TILE - 1) // lay.TILE
    tiles = tile_stops.size
    transmittance, last = planes
    for t in prange(threads):
        mine = scratch[t]
        while True:
            tile = fetch_add(counter, 1)
            if tile >= tiles:
                break
            left, top = lay.TILE * (tile % tiles_x), lay.TILE * (tile // tiles_x)
            plane, start, stop = _PIXELS * tile, tile_starts[tile], tile_stops[tile]
            touched[stop : tile_starts[tile + 1]] = 0
            if stop == start:
                continue
            _start_backward(
                left,
                top,
                width,
                height,
                plane,
                transmittance,
                image_grad,
                alpha_grad,
                (background[0], background[1], background[2]),
                mine,
            )
            _backward_tile(
                start,
                stop,
                np.float32(left),
                np.float32(top),
                plane,
                gaussians,
                blocks,
                records,
                last,
                touched,
                rows,
                mine,
            )
