"""Gaussians onto the screen, `LANES` at a time, and gradients back into space."""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.rasterizer.constants import ALPHA_MIN, QUATERNION_MIN
from chronoscene.rasterizer.cpu import layout as lay
from chronoscene.rasterizer.cpu.kernel import helper, inlined, kernel
from chronoscene.rasterizer.cpu.phases import draw
from chronoscene.rasterizer.cpu.simd import (
    LANES,
    absolute,
    as_float,
    as_int,
    floor,
    load,
    load3,
    load4,
    load16,
    load_records,
    maximum,
    minimum,
    select,
    splat,
    splat16,
    splat16_int,
    sqrt,
    store,
    store_columns,
    store_records,
    to_int,
)
from chronoscene.rasterizer.cpu.vecmath import log2

_HUGE = 1e30
_LEVEL_MIN = lay.LEVEL_MIN


@inlined
def _to_camera(camera: Any, x: Any, y: Any, z: Any) -> Any:
    return (
        camera[0] * x + (camera[1] * y + (camera[2] * z + camera[9])),
        camera[3] * x + (camera[4] * y + (camera[5] * z + camera[10])),
        camera[6] * x + (camera[7] * y + (camera[8] * z + camera[11])),
    )


@inlined
def _unit(w: Any, x: Any, y: Any, z: Any) -> Any:
    """Unit quaternion, one over its length, largest component; scaled lest squares underflow."""
    largest = maximum(maximum(absolute(w), absolute(x)), maximum(absolute(y), absolute(z)))
    scale = 1.0 / largest
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    inverse = 1.0 / sqrt(w * w + (x * x + (y * y + z * z)))
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse * scale, largest


@inlined
def _rotation(w: Any, x: Any, y: Any, z: Any) -> Any:
    """Rotation matrix of a unit quaternion, by rows."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@inlined
def _rotated_row(camera: Any, i: int, r: Any, s: Any) -> Any:
    """Row i of (world-to-camera rotation) (Gaussian's rotation) diag(scales)."""
    a, b, c = camera[3 * i], camera[3 * i + 1], camera[3 * i + 2]
    return (
        (a * r[0] + (b * r[3] + c * r[6])) * s[0],
        (a * r[1] + (b * r[4] + c * r[7])) * s[1],
        (a * r[2] + (b * r[5] + c * r[8])) * s[2],
    )


@inlined
def _dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + (a[1] * b[1] + a[2] * b[2])


@inlined
def _image_row(focal: Any, ratio: Any, m: Any, depth_row: Any) -> Any:
    """Row of J M: image axis of the three scaled axes; ``focal`` is f / z."""
    return (
        focal * (m[0] - ratio * depth_row[0]),
        focal * (m[1] - ratio * depth_row[1]),
        focal * (m[2] - ratio * depth_row[2]),
    )


@inlined
def _ellipse(a: Any, b: Any, blur: Any) -> Any:
    """Shear xy/yy, variance of x given y, variance of y, of Sigma = (a, b)(a, b)^T + blur I.

    The variance of x given y is the squared length of what is left of (a, sqrt(blur), 0) after
    its projection on (b, 0, sqrt(blur)): a sum of squares, exact for needles too, where
    xx - xy^2 / yy would cancel.
    """
    yy = _dot(b, b) + blur
    shear = _dot(a, b) / yy
    d = (a[0] - shear * b[0], a[1] - shear * b[1], a[2] - shear * b[2])
    return shear, _dot(d, d) + blur * (1.0 + shear * shear), yy


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
    x, y, z = load3(means, 3 * at)
    px, py, pz = _to_camera(camera, x, y, z)
    w, qx, qy, qz = load4(quats, 4 * at)
    w, qx, qy, qz, _, longest = _unit(w, qx, qy, qz)
    s = load3(scales, 3 * at)
    r = _rotation(w, qx, qy, qz)
    rz = 1.0 / pz
    tx, ty = px * rz, py * rz
    jx = minimum(maximum(tx, camera[lay.X_MIN]), camera[lay.X_MAX])
    jy = minimum(maximum(ty, camera[lay.Y_MIN]), camera[lay.Y_MAX])
    depth_row = _rotated_row(camera, 2, r, s)
    a = _image_row(camera[lay.FX] * rz, jx, _rotated_row(camera, 0, r, s), depth_row)
    b = _image_row(camera[lay.FY] * rz, jy, _rotated_row(camera, 1, r, s), depth_row)
    shear, xx_given_y, yy = _ellipse(a, b, camera[lay.BLUR])
    xx = xx_given_y + shear * shear * yy
    mx, my = camera[lay.FX] * tx + camera[lay.CX], camera[lay.FY] * ty + camera[lay.CY]

    opacity = load(opacities, at)
    level = log2(opacity)
    reach = (level - _LEVEL_MIN) * (2.0 / lay.LOG2_E)
    ex, ey = sqrt(reach * xx), sqrt(reach * yy)
    cr, cg, cb = load3(colors, 3 * at)
    # Comparisons with nan are false; the last line catches infinite colours.
    visible = (pz >= camera[lay.NEAR]) & (pz <= camera[lay.FAR])
    visible = visible & (opacity > ALPHA_MIN) & (opacity < _HUGE) & (reach > 0.0)
    visible = visible & (ex > 0.0) & (ex < _HUGE) & (ey > 0.0) & (ey < _HUGE)
    visible = visible & (mx + ex > 0.0) & (mx - ex < width)
    visible = visible & (my + ey > 0.0) & (my - ey < height) & (xx_given_y > 0.0)
    visible = visible & (longest >= QUATERNION_MIN)
    visible = visible & (absolute(cr) + absolute(cg) + absolute(cb) < _HUGE)

    # A little more than the ellipse: what is left out here must lie outside it after rounding.
    tx0, ntx = _tile_range(mx - ex * 1.001 - 0.01, mx + ex * 1.001 + 0.01, width)
    ty0, nty = _tile_range(my - ey * 1.001 - 0.01, my + ey * 1.001 + 0.01, height)
    drawn = visible & (ntx > 0) & (nty > 0)
    ntx, nty = select(drawn, ntx, 0), select(drawn, nty, 0)
    axis_xx, axis_yy = lay.WHITEN / sqrt(xx_given_y), lay.WHITEN / sqrt(yy)
    zero = splat(0.0)
    store_records(
        records,
        lay.RECORD * at,
        (
            mx,
            my,
            axis_xx,
            zero - axis_xx * shear,
            axis_yy,
            level,
            cr,
            cg,
            cb,
            shear,
            1.0 / axis_xx,
            shear * yy / xx * ex,
            as_float(tx0 + (ntx << 16)),
            as_float(ty0 + (nty << 16)),
            zero,
            zero,
        ),
    )
    store(keys, at, select(drawn, as_int(pz), -1))
    store_columns(means2d, 2 * at, (select(visible, mx, 0.0), select(visible, my, 0.0)))
    rx = to_int(minimum(zero - floor(zero - ex), 2e9))
    ry = to_int(minimum(zero - floor(zero - ey), 2e9))
    store_columns(
        radii,
        2 * at,
        (as_float(select(visible, rx, 0)), as_float(select(visible, ry, 0))),
    )
    store(depths, at, select(visible, pz, 0.0))


@helper
def chunk_of(gaussian, chunks):
    """Number of the chunk of a Gaussian."""
    return min(gaussian // lay.CHUNK, chunks - 1)


@helper
def chunk_range(chunk, chunks, n):
    """First Gaussian of a chunk and the end. The last one takes what is left of the division,
    so that none of several is shorter than a vector."""
    first = chunk * lay.CHUNK
    return first, n if chunk == chunks - 1 else first + lay.CHUNK


@helper
def _number_rows(first, last, records_int, row_starts):
    """Give each Gaussian one row for each tile of its rectangle. Returns the number of rows."""
    row = 0
    for gaussian in range(first, last):
        base = lay.RECORD * gaussian
        records_int[base + lay.ROW] = row
        row_starts[gaussian] = row
        row += (records_int[base + lay.TILES_X] >> 16) * (records_int[base + lay.TILES_Y] >> 16)
    return row


@helper
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


@inlined
def _sum_rows(row: int, end: int, touched: Any, rows: Any, total: Any) -> Any:
    """16 numbers plus rows row..end, in this order. The row after the last may be read.

    Most Gaussians have one or two rows: these are added without a branch, which would often be
    mispredicted.
    """
    wanted = (end > row) & (touched[row] != 0)
    total = total + select(splat16_int(np.int32(wanted)) > 0, load16(rows, lay.RECORD * row), 0.0)
    row += end > row
    wanted = (end > row) & (touched[row] != 0)
    total = total + select(splat16_int(np.int32(wanted)) > 0, load16(rows, lay.RECORD * row), 0.0)
    for r in range(row + 1, end):
        if touched[r] != 0:
            total = total + load16(rows, lay.RECORD * r)
    return total


@helper
def _rows_of(gaussian, last, chunk, numbering):
    """First row of a Gaussian and the end of its rows, in a chunk that ends before ``last``."""
    row_starts, row_bases = numbering
    base, end = row_bases[chunk], row_bases[chunk + 1]
    if gaussian + 1 < last:
        end = base + row_starts[gaussian + 1]
    return base + row_starts[gaussian], end


@kernel
def add_rows(worker, control, numbering, touched, rows, sums):
    """Add the rows of each Gaussian to its 16 numbers in ``sums``; see `project_backward`."""
    n, chunks = sums.size // lay.RECORD, numbering[1].size - 1
    chunk = draw(control, 0)
    while chunk < chunks:
        first, last = chunk_range(chunk, chunks, n)
        for i in range(first, last):
            row, end = _rows_of(i, last, chunk, numbering)
            at = lay.RECORD * i
            store(sums, at, _sum_rows(row, end, touched, rows, load16(sums, at)))
        chunk = draw(control, 0)


@kernel
def set_colors(values, channels, first, records):
    """Put up to three of the channels of each Gaussian into its record, zeros for missing ones."""
    for i in range(records.size // lay.RECORD):
        for c in range(3):
            value = np.float32(0.0)
            if first + c < channels:
                value = values[i * channels + first + c]
            records[lay.RECORD * i + lay.COLOR + c] = value


@inlined
def _quaternion_gradient(w: Any, x: Any, y: Any, z: Any, d: Any) -> Any:
    """Gradient of a unit quaternion from that of its rotation matrix, given by rows."""
    return (
        2.0 * (x * (d[7] - d[5]) + (y * (d[2] - d[6]) + z * (d[3] - d[1]))),
        2.0 * (w * (d[7] - d[5]) + y * (d[1] + d[3]) + z * (d[2] + d[6]))
        - 4.0 * (x * (d[4] + d[8])),
        2.0 * (w * (d[2] - d[6]) + x * (d[1] + d[3]) + z * (d[5] + d[7]))
        - 4.0 * (y * (d[0] + d[8])),
        2.0 * (w * (d[3] - d[1]) + x * (d[2] + d[6]) + y * (d[5] + d[7]))
        - 4.0 * (z * (d[0] + d[4])),
    )


@inlined
def _backward_group(at, sums, sums_at, gaussians, depth_gradients, camera, keys, grads):
    """Gradients of Gaussians at..at+LANES from their sums over pixels."""
    means, quats, scales, opacities, _ = gaussians
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_means2d = grads
    f = load_records(sums, sums_at)
    x, y, z = load3(means, 3 * at)
    px, py, pz = _to_camera(camera, x, y, z)
    w, qx, qy, qz = load4(quats, 4 * at)
    w, qx, qy, qz, inverse, _ = _unit(w, qx, qy, qz)
    s = load3(scales, 3 * at)
    r = _rotation(w, qx, qy, qz)
    rz = 1.0 / pz
    tx, ty = px * rz, py * rz
    jx = minimum(maximum(tx, camera[lay.X_MIN]), camera[lay.X_MAX])
    jy = minimum(maximum(ty, camera[lay.Y_MIN]), camera[lay.Y_MAX])
    m0, m1 = _rotated_row(camera, 0, r, s), _rotated_row(camera, 1, r, s)
    m2 = _rotated_row(camera, 2, r, s)
    fx, fy = camera[lay.FX] * rz, camera[lay.FY] * rz
    a, b = _image_row(fx, jx, m0, m2), _image_row(fy, jy, m1, m2)
    shear, xx_given_y, yy = _ellipse(a, b, camera[lay.BLUR])

    # Whitening A = [[i, -shear i], [0, k]]: Sigma^-1 = A^T A. The sums are over u, v, which are
    # WHITEN times the whitened offset A d; d loss / d Sigma = A^T (sum g (A d)(A d)^T) A / 2 and
    # d loss / d mean = A^T sum g A d.
    i, k = 1.0 / sqrt(xx_given_y), 1.0 / sqrt(yy)
    su, sv = f[lay.SUM_U] * (1.0 / lay.WHITEN), f[lay.SUM_V] * (1.0 / lay.WHITEN)
    scale = 1.0 / (lay.WHITEN * lay.WHITEN)
    suu, suv, svv = f[lay.SUM_UU] * scale, f[lay.SUM_UV] * scale, f[lay.SUM_VV] * scale
    gmx = i * su
    gmy = k * sv - shear * gmx
    # Twice d loss / d Sigma: [[hxx, hxy], [hxy, hyy]].
    hxx = i * i * suu
    hxy = i * k * suv - shear * hxx
    hyy = k * k * svv - shear * (i * k * suv + hxy)
    da = (hxx * a[0] + hxy * b[0], hxx * a[1] + hxy * b[1], hxx * a[2] + hxy * b[2])
    db = (hxy * a[0] + hyy * b[0], hxy * a[1] + hyy * b[1], hxy * a[2] + hyy * b[2])

    d0 = (fx * da[0], fx * da[1], fx * da[2])
    d1 = (fy * db[0], fy * db[1], fy * db[2])
    zero = splat(0.0)
    d2 = (
        zero - (jx * d0[0] + jy * d1[0]),
        zero - (jx * d0[1] + jy * d1[1]),
        zero - (jx * d0[2] + jy * d1[2]),
    )
    gjx = select((tx > camera[lay.X_MIN]) & (tx < camera[lay.X_MAX]), _dot(d0, m2), 0.0)
    gjy = select((ty > camera[lay.Y_MIN]) & (ty < camera[lay.Y_MAX]), _dot(d1, m2), 0.0)
    gpx, gpy = fx * gmx - rz * gjx, fy * gmy - rz * gjy
    gpz = zero - tx * gpx - ty * gpy - rz * (_dot(da, a) + _dot(db, b))
    if depth_gradients.size > 0:
        gpz = gpz + load(depth_gradients, at)

    # N = R_gaussian diag(s); d loss / d N = rotation^T (d0, d1, d2).
    n0 = (
        camera[0] * d0[0] + (camera[3] * d1[0] + camera[6] * d2[0]),
        camera[0] * d0[1] + (camera[3] * d1[1] + camera[6] * d2[1]),
        camera[0] * d0[2] + (camera[3] * d1[2] + camera[6] * d2[2]),
    )
    n1 = (
        camera[1] * d0[0] + (camera[4] * d1[0] + camera[7] * d2[0]),
        camera[1] * d0[1] + (camera[4] * d1[1] + camera[7] * d2[1]),
        camera[1] * d0[2] + (camera[4] * d1[2] + camera[7] * d2[2]),
    )
    n2 = (
        camera[2] * d0[0] + (camera[5] * d1[0] + camera[8] * d2[0]),
        camera[2] * d0[1] + (camera[5] * d1[1] + camera[8] * d2[1]),
        camera[2] * d0[2] + (camera[5] * d1[2] + camera[8] * d2[2]),
    )
    gw, gx, gy, gz = _quaternion_gradient(
        w,
        qx,
        qy,
        qz,
        (
            n0[0] * s[0],
            n0[1] * s[1],
            n0[2] * s[2],
            n1[0] * s[0],
            n1[1] * s[1],
            n1[2] * s[2],
            n2[0] * s[0],
            n2[1] * s[1],
            n2[2] * s[2],
        ),
    )
    along = w * gw + (qx * gx + (qy * gy + qz * gz))

    # Culled lanes hold nan: select, do not multiply by zero.
    drawn = load(keys, at) >= 0
    store_columns(
        grad_means,
        3 * at,
        (
            select(drawn, camera[0] * gpx + (camera[3] * gpy + camera[6] * gpz), 0.0),
            select(drawn, camera[1] * gpx + (camera[4] * gpy + camera[7] * gpz), 0.0),
            select(drawn, camera[2] * gpx + (camera[5] * gpy + camera[8] * gpz), 0.0),
        ),
    )
    store_columns(
        grad_quats,
        4 * at,
        (
            select(drawn, (gw - along * w) * inverse, 0.0),
            select(drawn, (gx - along * qx) * inverse, 0.0),
            select(drawn, (gy - along * qy) * inverse, 0.0),
            select(drawn, (gz - along * qz) * inverse, 0.0),
        ),
    )
    store_columns(
        grad_scales,
        3 * at,
        (
            select(drawn, n0[0] * r[0] + (n1[0] * r[3] + n2[0] * r[6]), 0.0),
            select(drawn, n0[1] * r[1] + (n1[1] * r[4] + n2[1] * r[7]), 0.0),
            select(drawn, n0[2] * r[2] + (n1[2] * r[5] + n2[2] * r[8]), 0.0),
        ),
    )
    store(grad_opacities, at, select(drawn, f[lay.SUM] / load(opacities, at), 0.0))
    store_columns(
        grad_colors,
        3 * at,
        (
            select(drawn, f[lay.SUM_COLOR], 0.0),
            select(drawn, f[lay.SUM_COLOR + 1], 0.0),
            select(drawn, f[lay.SUM_COLOR + 2], 0.0),
        ),
    )
    store_columns(grad_means2d, 2 * at, (select(drawn, gmx, 0.0), select(drawn, gmy, 0.0)))


@kernel
def project_backward(
    worker, control, gaussians, depth_gradients, camera, keys, numbering, touched, rows, sums, grads
):
    """Reduce the rows of all Gaussians in fixed order and turn them into gradients.

    Args:
        worker, control: See `team.launch`; a job is a chunk of Gaussians.
        gaussians, camera, keys: As in `project_chunk`.
        depth_gradients: d loss / d z-depth that did not come through the projection; or nothing.
        numbering: (first row of each Gaussian in its chunk, first row of each chunk and the end).
        touched: Whether a row was written.
        rows: Sums over the pixels of a tile. Without any, ``sums`` are taken as they are.
        sums: Scratch, 16 * LANES per worker; without rows, 16 for each Gaussian.
        grads: (means, quats, scales, opacities, colors, means2d), written.
    """
    n, chunks = keys.size, numbering[1].size - 1
    scratch = lay.RECORD * LANES * worker
    chunk = draw(control, 0)
    while chunk < chunks:
        first, last = chunk_range(chunk, chunks, n)
        for i in range(first, last, LANES):
            at = min(i, last - LANES)
            place = lay.RECORD * at
            if rows.size > 0:
                place = scratch
                for lane in range(LANES):
                    row, end = _rows_of(at + lane, last, chunk, numbering)
                    total = _sum_rows(row, end, touched, rows, splat16(0.0))
                    store(sums, place + lay.RECORD * lane, total)
            _backward_group(at, sums, place, gaussians, depth_gradients, camera, keys, grads)
        chunk = draw(control, 0)
