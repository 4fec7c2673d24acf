"""Tiles and blocks that each Gaussian touches, and the list of Gaussians of every tile.

In the order of drawing, the (Gaussian, tile, blocks) pairs of each part are written to a region of
a list; a stable counting sort by tile then keeps the order of drawing in every tile,
whatever the number of parts.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import prefetch
from chronoscene.kernels.thread_pool import draw, finish, wait_for
from chronoscene.kernels.vectors import (
    floor,
    make_constant,
    maximum,
    minimum,
    pack_bytes,
    select,
    sqrt,
    to_int,
)
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.project import chunk_of, project_chunk
from chronoscene.rasterizer.cpu.sort import SORT_PHASES, sort_phases

# A pixel on the rim of the ellipse may pass the test of its alpha after rounding; the blocks must
# include it. In units of log2(alpha).
_SLACK = 1e-3
_LEVEL_MIN = layout.LEVEL_MIN - _SLACK

_block_rows = make_constant([4.0 * i + 0.5 for i in range(8)])  # first row of centres of each


@inlined
def _columns(mx: Any, my: Any, tile_y: int, record: Any, at: int, width: int) -> Any:
    """First and last block column that the ellipse covers in each block row of a tile row.

    Over a strip of rows of pixel centres, the ellipse reaches farthest right at the height of its
    rightmost point, or at the end of the strip nearest to it; likewise left. A strip that the
    ellipse misses has no real solution there.
    """
    top = _block_rows() + np.float32(32 * tile_y - my)
    bottom = top + 3.0
    shear, half = record[at + layout.SHEAR], record[at + layout.HALF_WIDTH]
    rightmost = record[at + layout.RIGHTMOST]
    inverse_y, reach = record[at + layout.INVERSE_Y], record[at + layout.LEVEL] - _LEVEL_MIN
    yr = minimum(maximum(top, rightmost), bottom)
    yl = minimum(maximum(top, -rightmost), bottom)
    vr, vl = yr * inverse_y, yl * inverse_y
    qr, ql = reach - vr * vr, reach - vl * vl
    right = mx - np.float32(0.5) + (yr * shear + sqrt(maximum(qr, 0.0)) * half)
    left = mx - np.float32(0.5) + (yl * shear - sqrt(maximum(ql, 0.0)) * half)
    first = 0.0 - floor(0.0 - minimum(maximum(left, 0.0), np.float32(width)))
    last = floor(minimum(maximum(right, -1.0), np.float32(width - 1)))
    hit = (qr >= 0.0) & (ql >= 0.0) & (first <= last)
    return to_int(first) >> 2, select(hit, to_int(last) >> 2, -1)


@inlined
def _tile_blocks(first: Any, last: Any, tile_x: int) -> Any:
    """Bits of the blocks between two columns in each row, within one tile."""
    low = maximum(first - np.int32(8 * tile_x), 0)
    high = minimum(last - np.int32(8 * tile_x), 7)
    some = low <= high
    low, high = select(some, low, 0), select(some, high, 0)
    bits = (255 << low) & (255 >> (7 - high))
    return pack_bytes(select(some, bits, 0))


@inner(fast_math=True)
def _list_part(first, last, at, limit, order, view, scene, counts, listed):
    """Pairs of the Gaussians first..last of the order of drawing. Returns the list's end.

    If the list is too short for them, its end is beyond ``limit``. What is sorted begins with how
    far the bits of the depth are above those of the nearest Gaussian.
    """
    width, tiles_x = view
    records, records_int, row_bases, nearest = scene
    list_tile, (list_blocks, list_numbers) = listed
    counts[:] = 0
    for i in range(first, last):
        gaussian = order[i] & 0xFFFFFFFF
        if i + 8 < last:
            prefetch(records, layout.RECORD * (order[i + 8] & 0xFFFFFFFF))
        base = layout.RECORD * gaussian
        xs, ys = records_int[base + layout.TILES_X], records_int[base + layout.TILES_Y]
        row = row_bases[chunk_of(gaussian, row_bases.size - 1)] + records_int[base + layout.ROW]
        if at + (xs >> 16) * (ys >> 16) > limit:
            return limit + 1
        mx, my = records[base], records[base + 1]
        for tile_y in range(ys & 0xFFFF, (ys & 0xFFFF) + (ys >> 16)):
            left, right = _columns(mx, my, tile_y, records, base, width)
            for tile_x in range(xs & 0xFFFF, (xs & 0xFFFF) + (xs >> 16)):
                blocks = _tile_blocks(left, right, tile_x)
                if blocks != 0:
                    tile = tile_y * tiles_x + tile_x
                    list_tile[at] = tile
                    list_blocks[layout.ENTRY_BLOCKS * at] = blocks
                    number = layout.ENTRY_NUMBERS * at
                    list_numbers[number + layout.GAUSSIAN] = gaussian
                    list_numbers[number + layout.PLACE] = row
                    counts[tile] += 1
                    at += 1
                    row += 1
        records_int[base + layout.DEPTH] = nearest + (order[i] >> 32)
    return at


@inner(fast_math=True)
def _tile_offsets(counts, tile_starts):
    """Turn counts by part and tile into places: by tile, within a tile by part."""
    total = 0
    for tile in range(counts.shape[1]):
        tile_starts[tile] = total
        for part in range(counts.shape[0]):
            count = counts[part, tile]
            counts[part, tile] = total
            total += count
    tile_starts[counts.shape[1]] = total


@inner(fast_math=True)
def _order_tiles(tile_starts, tile_order):
    """Tiles with many entries first, so that the last ones to be taken are short. A counting sort
    by a quarter of the number's logarithm."""
    tiles = tile_order.size
    counts = np.zeros(257, np.int64)
    for tile in range(tiles):
        counts[256 - _weight(tile_starts[tile + 1] - tile_starts[tile])] += 1
    for bucket in range(1, 257):
        counts[bucket] += counts[bucket - 1]
    for tile in range(tiles - 1, -1, -1):
        bucket = 256 - _weight(tile_starts[tile + 1] - tile_starts[tile])
        counts[bucket] -= 1
        tile_order[counts[bucket]] = tile


@inner(fast_math=True)
def _weight(count):
    """Four times the logarithm to base 2, roughly; 0 for 0."""
    octave = 0
    while count >> octave > 0:
        octave += 1
    return 4 * octave + ((count << 3 >> octave) & 3 if octave > 0 else 0)


@inner(fast_math=True)
def _scatter_part(first, last, places, listed, entries):
    list_tile, (source, _) = listed
    target, _ = entries
    for j in range(first, last):
        tile = list_tile[j]
        place = places[tile]
        places[tile] = place + 1
        to, at = layout.ENTRY_BLOCKS * place, layout.ENTRY_BLOCKS * j
        target[to], target[to + 1] = source[at], source[at + 1]


@inner(fast_math=True)
def _sum_up(row_bases):
    """Turn the numbers of rows of the chunks, each one place late, into first rows."""
    row_bases[0] = 0
    for chunk in range(1, row_bases.size):
        row_bases[chunk] += row_bases[chunk - 1]


@inner(fast_math=True)
def _list_phase(control, phase, starts, ends, order, count, view, scene, counts, listed):
    """List the pairs of each part and count them by tile; True if the memory sufficed."""
    parts = ends.size
    part = draw(control, phase)
    while part < parts:
        first, last = count * part // parts, count * (part + 1) // parts
        at, limit = starts[part], starts[part + 1]
        ends[part] = _list_part(first, last, at, limit, order, view, scene, counts[part], listed)
        finish(control, phase)
        part = draw(control, phase)
    wait_for(control, phase, parts)
    room = True
    for part in range(parts):
        room &= ends[part] <= starts[part + 1]
    return room


@kernel(fast_math=True, extras=[constants])
def bin_gaussians(
    worker, control, gaussians, camera, view, records, keys, numbering, out, sorting, parts, tiles
):
    """From Gaussians to the list of every tile, in one launch.

    Args:
        worker, control: See `thread_pool.launch`; `BIN_PHASES` phases.
        gaussians, camera, records, keys, numbering, out: See `project.project_chunk`.
        view: (width, height, tiles per row).
        sorting: (counts, pairs, spare, result) of `sort.sort_phases`. The last has a fourth number
            that is set to 1 if there was not enough room to list the pairs.
        parts: (where each part may write and the end, where it stopped). int64
        tiles: (scratch by part and tile int64, start of each tile and the end int64, order of
            tiles int32, listed (tile int32, entries), entries); the last is the result. Entries are
            the same memory as uint64 and as int32, see `layout`.
    """
    width, height, tiles_x = view
    _, row_bases = numbering
    chunks = row_bases.size - 1
    chunk = draw(control, 0)
    while chunk < chunks:
        project_chunk(
            chunk, chunks, gaussians, camera, (width, height), records, keys, numbering, out
        )
        finish(control, 0)
        chunk = draw(control, 0)
    wait_for(control, 0, chunks)
    if draw(control, 1) == 0:
        _sum_up(row_bases)
        finish(control, 1)

    digits, pairs, spare, result = sorting
    phase, in_spare = sort_phases(control, 2, keys, digits, pairs, spare, result)
    order = spare if in_spare else pairs
    wait_for(control, 1, 1)

    starts, ends = parts
    counts, tile_starts, tile_order, listed, entries = tiles
    scene = (records[0], records[1], row_bases, result[1])
    if not _list_phase(
        control, phase, starts, ends, order, result[0], (width, tiles_x), scene, counts, listed
    ):
        result[3] = 1
        return
    if draw(control, phase + 1) == 0:
        _tile_offsets(counts, tile_starts)
        _order_tiles(tile_starts, tile_order)
        finish(control, phase + 1)
    wait_for(control, phase + 1, 1)
    part = draw(control, phase + 2)
    while part < ends.size:
        _scatter_part(starts[part], ends[part], counts[part], listed, entries)
        part = draw(control, phase + 2)


BIN_PHASES = 2 + SORT_PHASES + 3
