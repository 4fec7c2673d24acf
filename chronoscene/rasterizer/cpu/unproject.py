"""Gradients on the screen back into space, `LANES` Gaussians at a time."""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.rasterizer.cpu import layout as lay
from chronoscene.rasterizer.cpu.geometry import dot, project_axes, unit
from chronoscene.rasterizer.cpu.kernel import helper, inlined, kernel
from chronoscene.rasterizer.cpu.phases import draw
from chronoscene.rasterizer.cpu.project import chunk_range
from chronoscene.rasterizer.cpu.simd import (
    LANES,
    load,
    load3,
    load4,
    load16,
    load_records,
    select,
    splat,
    splat16,
    splat16_int,
    sqrt,
    store,
    store_columns,
)


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
def _turned_back(camera: Any, i: int, d0: Any, d1: Any, d2: Any) -> Any:
    """Row i of the transposed world-to-camera rotation times the matrix of rows d0, d1, d2."""
    a, b, c = camera[i], camera[3 + i], camera[6 + i]
    return (
        a * d0[0] + (b * d1[0] + c * d2[0]),
        a * d0[1] + (b * d1[1] + c * d2[1]),
        a * d0[2] + (b * d1[2] + c * d2[2]),
    )


@inlined
def _times(a: Any, b: Any) -> Any:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inlined
def _keep(mask: Any, values: Any) -> Any:
    """Three vectors, zero where the mask is not set, whatever was there."""
    return (
        select(mask, values[0], 0.0),
        select(mask, values[1], 0.0),
        select(mask, values[2], 0.0),
    )


@inlined
def _backward_group(at, sums, sums_at, gaussians, depth_gradients, camera, keys, grads):
    """Gradients of Gaussians at..at+LANES from their sums over pixels."""
    means, quats, scales, opacities, _ = gaussians
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_means2d = grads
    f = load_records(sums, sums_at)
    w, qx, qy, qz = load4(quats, 4 * at)
    w, qx, qy, qz, inverse, _ = unit(w, qx, qy, qz)
    s = load3(scales, 3 * at)
    pz, (tx, ty), (jx, jy), r, m2, (_, b), (shear, xx_given_y, yy, d) = project_axes(
        camera, load3(means, 3 * at), (w, qx, qy, qz), s
    )
    rz = 1.0 / pz
    fx, fy = camera[lay.FX] * rz, camera[lay.FY] * rz

    # Whitening A = [[i, -shear i], [0, k]]: Sigma^-1 = A^T A. The sums are over u, v, which are
    # WHITEN times the whitened offset A d; d loss / d Sigma = A^T (sum g (A d)(A d)^T) A / 2 and
    # d loss / d mean = A^T sum g A d.
    i, k = 1.0 / sqrt(xx_given_y), 1.0 / sqrt(yy)
    su, sv = f[lay.SUM_U] * (1.0 / lay.WHITEN), f[lay.SUM_V] * (1.0 / lay.WHITEN)
    scale = 1.0 / (lay.WHITEN * lay.WHITEN)
    suu, suv, svv = f[lay.SUM_UU] * scale, f[lay.SUM_UV] * scale, f[lay.SUM_VV] * scale
    gmx = i * su
    gmy = k * sv - shear * gmx
    # A (a, b) = (i d, k b) with d = a - shear b: the gradients of a and b from those of the
    # whitened rows, in terms of d lest they cancel for needles.
    huu, huv, hvv = i * i * suu, i * k * suv, k * k * svv
    da = (huu * d[0] + huv * b[0], huu * d[1] + huv * b[1], huu * d[2] + huv * b[2])
    db = (
        huv * d[0] + hvv * b[0] - shear * da[0],
        huv * d[1] + hvv * b[1] - shear * da[1],
        huv * d[2] + hvv * b[2] - shear * da[2],
    )
    turning = huu * dot(d, d) + 2.0 * huv * dot(d, b) + hvv * dot(b, b)  # da . a + db . b

    d0 = (fx * da[0], fx * da[1], fx * da[2])
    d1 = (fy * db[0], fy * db[1], fy * db[2])
    zero = splat(0.0)
    d2 = (
        zero - (jx * d0[0] + jy * d1[0]),
        zero - (jx * d0[1] + jy * d1[1]),
        zero - (jx * d0[2] + jy * d1[2]),
    )
    gjx = select((tx > camera[lay.X_MIN]) & (tx < camera[lay.X_MAX]), dot(d0, m2), 0.0)
    gjy = select((ty > camera[lay.Y_MIN]) & (ty < camera[lay.Y_MAX]), dot(d1, m2), 0.0)
    gpx, gpy = fx * gmx - rz * gjx, fy * gmy - rz * gjy
    gpz = zero - tx * gpx - ty * gpy - rz * turning
    if depth_gradients.size > 0:
        gpz = gpz + load(depth_gradients, at)

    # N = R_gaussian diag(s); d loss / d N = rotation^T (d0, d1, d2).
    n0 = _turned_back(camera, 0, d0, d1, d2)
    n1 = _turned_back(camera, 1, d0, d1, d2)
    n2 = _turned_back(camera, 2, d0, d1, d2)
    dr = (*_times(n0, s), *_times(n1, s), *_times(n2, s))
    gw, gx, gy, gz = _quaternion_gradient(w, qx, qy, qz, dr)
    along = w * gw + (qx * gx + (qy * gy + qz * gz))

    # Culled lanes hold nan: select, do not multiply by zero.
    drawn = load(keys, at) >= 0
    gm = (
        camera[0] * gpx + (camera[3] * gpy + camera[6] * gpz),
        camera[1] * gpx + (camera[4] * gpy + camera[7] * gpz),
        camera[2] * gpx + (camera[5] * gpy + camera[8] * gpz),
    )
    store_columns(grad_means, 3 * at, _keep(drawn, gm))
    gq = _keep(
        drawn,
        ((gx - along * qx) * inverse, (gy - along * qy) * inverse, (gz - along * qz) * inverse),
    )
    gw = select(drawn, (gw - along * w) * inverse, 0.0)
    store_columns(grad_quats, 4 * at, (gw, gq[0], gq[1], gq[2]))
    gs = (
        n0[0] * r[0] + (n1[0] * r[3] + n2[0] * r[6]),
        n0[1] * r[1] + (n1[1] * r[4] + n2[1] * r[7]),
        n0[2] * r[2] + (n1[2] * r[5] + n2[2] * r[8]),
    )
    store_columns(grad_scales, 3 * at, _keep(drawn, gs))
    store(grad_opacities, at, select(drawn, f[lay.SUM] / load(opacities, at), 0.0))
    gc = (f[lay.SUM_COLOR], f[lay.SUM_COLOR + 1], f[lay.SUM_COLOR + 2])
    store_columns(grad_colors, 3 * at, _keep(drawn, gc))
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
