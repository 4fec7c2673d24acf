"""Gaussians onto the screen, `LANES` at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import store
from chronoscene.kernels.transposes import store_columns, store_records
from chronoscene.kernels.vector_math import log2
from chronoscene.kernels.vectors import (
    absolute,
    as_float,
    as_int,
    floor,
    maximum,
    minimum,
    select,
    sqrt,
    to_int,
)
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.ellipses import (
    by,
    dot,
    ellipse,
    project_axes,
    rotation,
    scaled,
    times,
)
from chronoscene.rasterizer.cpu.layout import LANES, load, load_quads, load_triples, splat

_RADIUS_MAX = float(constants.RADIUS_MAX)


@inlined
def _tile_range(low: Any, high: Any, size: int) -> Any:
    """First tile and number of tiles of pixel centres between two coordinates."""
    first = maximum(minimum(0.0 - floor(0.5 - low), float(size)), 0.0)
    last = minimum(maximum(floor(high - 0.5), -1.0), float(size - 1))
    start = to_int(first) >> 5
    count = (to_int(last + 32.0) >> 5) - start
    return start, select(last < first, 0, count)


@inlined
def _project_group(at, gaussians, camera, size, records, keys, out):
    """Project Gaussians at..at+LANES into records, sort keys and what the caller sees."""
    means, quats, scales, opacities, colors = gaussians
    width, height = size
    means2d, radii, depths = out
    w, x, y, z = load_quads(quats, 4 * at)
    (w, x, y, z), length2, _, longest = scaled(w, x, y, z)
    (pz, rz, (tx, ty), _), _, rows, normal = project_axes(
        camera, load_triples(means, 3 * at), rotation(w, x, y, z)
    )
    sizes = by(rz, load_triples(scales, 3 * at))
    s = by(1.0 / length2, sizes)
    # Rows a, b of J M: Sigma = ((aa, ab), (ab, bb)) + blur I.
    a, b = times(rows[0], s), times(rows[1], s)
    xx, yy = dot(a, a) + camera[layout.BLUR], dot(b, b) + camera[layout.BLUR]
    sideways = xx > yy
    _, _, shear, given, (second, inverse), _, (_, n) = ellipse(
        rows, normal, s, sizes, camera[layout.BLUR], sideways
    )
    # m = (f_x x / z + c_x, f_y y / z + c_y).
    mx, my = camera[layout.FX] * tx + camera[layout.CX], camera[layout.FY] * ty + camera[layout.CY]

    zero, inverse_given, inverse_y = splat(0.0), 1.0 / sqrt(given), 1.0 / sqrt(yy)
    antialiased = splat(camera[layout.ANTIALIASED]) > zero
    opacity = load(opacities, at) * select(antialiased, sqrt(dot(n, n)) * inverse_given, 1.0)
    level = log2(opacity)
    # Half extents of the ellipse alpha >= 1/255: sqrt(2 ln(255 o) Sigma_xx), likewise for y.
    reach = (level - layout.LEVEL_MIN) * (2.0 / layout.LOG2_E)
    ex, ey = sqrt(reach * xx), sqrt(reach * yy)
    cr, cg, cb = load_triples(colors, 3 * at)
    # Comparisons with nan are false.
    visible = (pz >= camera[layout.NEAR]) & (pz <= camera[layout.FAR])
    visible = visible & (opacity > constants.ALPHA_MIN) & (opacity < constants.VALUE_MAX)
    visible = visible & (reach > 0.0)
    visible = visible & (ex > 0.0) & (ex < constants.EXTENT_MAX)
    visible = visible & (ey > 0.0) & (ey < constants.EXTENT_MAX)
    visible = visible & (mx + ex > 0.0) & (mx - ex < width)
    visible = visible & (my + ey > 0.0) & (my - ey < height) & (given > 0.0)
    visible = visible & (longest >= constants.QUATERNION_MIN)
    visible = visible & (absolute(cr) < constants.VALUE_MAX) & (absolute(cg) < constants.VALUE_MAX)
    visible = visible & (absolute(cb) < constants.VALUE_MAX)

    # A little more than the ellipse: what is left out here must lie outside it after rounding.
    tx0, ntx = _tile_range(mx - ex * 1.001 - 0.01, mx + ex * 1.001 + 0.01, width)
    ty0, nty = _tile_range(my - ey * 1.001 - 0.01, my + ey * 1.001 + 0.01, height)
    drawn = visible & (ntx > 0) & (nty > 0)
    ntx, nty = select(drawn, ntx, 0), select(drawn, nty, 0)
    xy = shear * second
    # The conic Sigma^-1 = W^T W with W = ((1, -shear) / sqrt(given), (0, 1) / sqrt(second)): u and
    # v are the rows of W times WHITEN.
    u, v = layout.WHITEN * inverse_given, layout.WHITEN * inverse
    u_sheared = zero - u * shear
    # The standard deviation of x given y: the root of the determinant over that of y.
    half = (given * inverse_given) * (second * inverse) * inverse_y
    conic = (
        select(sideways, u_sheared, u),
        select(sideways, u, u_sheared),
        select(sideways, zero - v, v),
    )
    spans = (xy * inverse_y * inverse_y, half * (1.0 / layout.WHITEN), xy / xx * ex)
    tiles = (as_float(tx0 + (ntx << 16)), as_float(ty0 + (nty << 16)))
    record = (mx, my, *conic, level, cr, cg, cb, *spans, *tiles, zero, layout.WHITEN * inverse_y)
    store_records(records, layout.RECORD * at, record)
    store(keys, at, select(drawn, as_int(pz), -1))
    store_columns(means2d, 2 * at, (select(visible, mx, 0.0), select(visible, my, 0.0)))
    rx = to_int(minimum(zero - floor(zero - ex), _RADIUS_MAX))
    ry = to_int(minimum(zero - floor(zero - ey), _RADIUS_MAX))
    rx, ry = select(visible, rx, 0), select(visible, ry, 0)
    store_columns(radii, 2 * at, (as_float(rx), as_float(ry)))
    store(depths, at, select(visible, pz, 0.0))


@inner(fast_math=True)
def chunk_of(gaussian, chunks):
    """Number of the chunk of a Gaussian."""
    return min(gaussian // layout.CHUNK, chunks - 1)


@inner(fast_math=True)
def chunk_range(chunk, chunks, n):
    """First Gaussian of a chunk and the end. The last one takes what is left of the division,
    so that none of several is shorter than a vector."""
    first = chunk * layout.CHUNK
    return first, n if chunk == chunks - 1 else first + layout.CHUNK


@inner(fast_math=True)
def _number_rows(first, last, records_int, row_starts):
    """Give each Gaussian one row for each tile of its rectangle. Returns the number of rows."""
    row = 0
    for gaussian in range(first, last):
        base = layout.RECORD * gaussian
        records_int[base + layout.ROW] = row
        row_starts[gaussian] = row
        tiles_x, tiles_y = records_int[base + layout.TILES_X], records_int[base + layout.TILES_Y]
        row += (tiles_x >> 16) * (tiles_y >> 16)
    return row


@inner(fast_math=True)
def project_chunk(chunk, chunks, gaussians, camera, size, records, keys, numbering, out):
    """Project the Gaussians of a chunk. At least `LANES` of them; arrays are flat.

    The last group overlaps the one before, so that no lane is ever outside the arrays.

    Args:
        chunk, chunks: Number of the chunk, and of chunks.
        gaussians: (means, quats, scales, opacities, colors), flat float32.
        camera: `layout.CAMERA` numbers.
        size: (width, height) of the image in pixels.
        records: Written, `layout.RECORD` numbers each: (as float32, as int32) of the same memory.
        keys: Written, int32: the bits of the depth, -1 if there is nothing to draw.
        numbering: (first row of each Gaussian in its chunk, number of rows of each chunk one place
            later), written: as many as the rectangle around it has tiles. int32, int64
        out: (means2d, radii as float bits, depths), written, zero where culled.
    """
    first, last = chunk_range(chunk, chunks, keys.size)
    for i in range(first, last, LANES):
        _project_group(min(i, last - LANES), gaussians, camera, size, records[0], keys, out)
    row_starts, row_bases = numbering
    row_bases[chunk + 1] = _number_rows(first, last, records[1], row_starts)


@kernel(fast_math=True, extras=[constants])
def set_colors(values, channels, first, records):
    """Put up to three of the channels of each Gaussian into its record, zeros for missing ones."""
    for i in range(records.size // layout.RECORD):
        for c in range(3):
            value = np.float32(0.0)
            if first + c < channels:
                value = values[i * channels + first + c]
            records[layout.RECORD * i + layout.COLOR + c] = value
