"""Gradients on the screen back into space, `LANES` Gaussians at a time."""

from __future__ import annotations

from typing import Any

import numpy as np

from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import make_load, store
from chronoscene.kernels.thread_pool import draw
from chronoscene.kernels.transposes import make_load_records, store_columns
from chronoscene.kernels.vectors import make_splat, select, sqrt
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.cpu import layout
from chronoscene.rasterizer.cpu.ellipses import (
    by,
    cross,
    dot,
    either,
    ellipse,
    plus,
    project_axes,
    rotation,
    scaled,
    times,
)
from chronoscene.rasterizer.cpu.layout import LANES, load, load_quads, load_triples, splat
from chronoscene.rasterizer.cpu.project import chunk_range

_load_records = make_load_records(LANES)
_load_row = make_load(16)
_splat_row, _splat_row_int = make_splat("f32", 16), make_splat("i32", 16)


@inlined
def _sum_rows(row: int, end: int, touched: Any, rows: Any, total: Any) -> Any:
    """16 numbers plus rows row..end, in this order. The row after the last may be read.

    Most Gaussians have one or two rows: these are added without a branch, which would often be
    mispredicted.
    """
    wanted = _splat_row_int(np.int32((end > row) & (touched[row] != 0))) > 0
    total = total + select(wanted, _load_row(rows, layout.RECORD * row), 0.0)
    row += end > row
    wanted = _splat_row_int(np.int32((end > row) & (touched[row] != 0))) > 0
    total = total + select(wanted, _load_row(rows, layout.RECORD * row), 0.0)
    for r in range(row + 1, end):
        if touched[r] != 0:
            total = total + _load_row(rows, layout.RECORD * r)
    return total


@inner(fast_math=True)
def _rows_of(gaussian, last, chunk, numbering):
    """First row of a Gaussian and the end of its rows, in a chunk that ends before ``last``."""
    row_starts, row_bases = numbering
    base, end = row_bases[chunk], row_bases[chunk + 1]
    if gaussian + 1 < last:
        end = base + row_starts[gaussian + 1]
    return base + row_starts[gaussian], end


@kernel(fast_math=True, extras=[constants])
def add_rows(worker, control, numbering, touched, rows, sums):
    """Add the rows of each Gaussian to its 16 numbers in ``sums``; see `project_backward`."""
    n, chunks = sums.size // layout.RECORD, numbering[1].size - 1
    chunk = draw(control, 0)
    while chunk < chunks:
        first, last = chunk_range(chunk, chunks, n)
        for i in range(first, last):
            row, end = _rows_of(i, last, chunk, numbering)
            at = layout.RECORD * i
            store(sums, at, _sum_rows(row, end, touched, rows, _load_row(sums, at)))
        chunk = draw(control, 0)


@inlined
def _quaternion_gradient(w: Any, x: Any, y: Any, z: Any, d: Any) -> Any:
    """Gradient of a unit quaternion from that of its rotation matrix, given by rows; of one of
    another length, times that."""
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
def _keep(mask: Any, values: Any) -> Any:
    """Three vectors, zero where the mask is not set, whatever was there."""
    return (
        select(mask, values[0], 0.0),
        select(mask, values[1], 0.0),
        select(mask, values[2], 0.0),
    )


@inlined
def _backward_group(at, sums, sums_at, gaussians, camera, keys, grads):
    """Gradients of Gaussians at..at+LANES from their sums over pixels."""
    means, quats, scales, opacities, _ = gaussians
    grad_means, grad_quats, grad_scales, grad_opacities, grad_colors, grad_means2d = grads
    f = _load_records(sums, sums_at)
    w, qx, qy, qz = load_quads(quats, 4 * at)
    (w, qx, qy, qz), length2, power, _ = scaled(w, qx, qy, qz)
    r = rotation(w, qx, qy, qz)
    position = load_triples(means, 3 * at)
    (_, rz, (tx, ty), (jx, jy)), m2, rows, normal = project_axes(camera, position, r)
    inverse2 = 1.0 / length2
    sizes = by(rz, load_triples(scales, 3 * at))
    s = by(inverse2, sizes)
    sideways = f[layout.SUM_SIGN] < 0.0
    b, second, shear, given, (_, inverse_b), rest, (a, n) = ellipse(
        rows, normal, s, sizes, camera[layout.BLUR], sideways
    )

    # Whitening W = [[i, -shear i], [0, k]] for offsets (first, second): Sigma^-1 = W^T W. The sums
    # are over u, v, which are WHITEN times the whitened offset W d; d loss / d Sigma =
    # W^T (sum g (W d)(W d)^T) W / 2 and d loss / d mean = W^T sum g W d.
    i, zero = 1.0 / sqrt(given), splat(0.0)
    k = select(sideways, zero - inverse_b, inverse_b)
    su, sv = f[layout.SUM_U] * (1.0 / layout.WHITEN), f[layout.SUM_V] * (1.0 / layout.WHITEN)
    scale = 1.0 / (layout.WHITEN * layout.WHITEN)
    suu, suv, svv = f[layout.SUM_UU] * scale, f[layout.SUM_UV] * scale, f[layout.SUM_VV] * scale
    gm_first = i * su
    gm_second = k * sv - shear * gm_first
    gmx, gmy = select(sideways, gm_second, gm_first), select(sideways, gm_first, gm_second)
    # W (a, b) = (i d, k b) with d = a - shear b: the gradients of d and b from those of the
    # whitened rows. Those of a and b are of parts that cancel in needles; not these.
    huu, huv, hvv = i * i * suu, i * k * suv, k * k * svv
    d = times(rest, s)
    gd = plus(by(huu, d), by(huv, b))
    gb = plus(by(huv, d), by(hvv, b))
    # Where the opacity is multiplied by c = |n| i, the root of det Sigma' / det Sigma with Sigma'
    # the covariance without the blur: d ln c / d (a, b) = (Sigma'^-1 - Sigma^-1) (a, b) =
    # blur Sigma^-1 (b x N, N x a) / |N|^2 with N = a x b = n / k.
    fade = f[layout.SUM] * camera[layout.BLUR] * (1.0 / dot(n, n)) * inverse_b
    fade = select(splat(camera[layout.ANTIALIASED]) > zero, fade, zero)
    gd = plus(gd, by(fade * i * i, cross(plus(b, by(shear, a)), n)))
    gb = plus(gb, by(fade * k * k, cross(n, a)))
    gs = plus(times(gd, rest), times(gb, second))
    turning = dot(gs, s)
    gb = plus(gb, by(0.0 - shear, gd))
    row_x, row_y = either(sideways, gb, gd), either(sideways, gd, gb)

    d0 = times(by(camera[layout.FX], row_x), sizes)
    d1 = times(by(camera[layout.FY], row_y), sizes)
    d2 = plus(by(zero - jx, d0), by(zero - jy, d1))
    # The Jacobian's x / z and y / z have a gradient only where they are not held.
    free_x = (tx > camera[layout.X_MIN]) & (tx < camera[layout.X_MAX])
    free_y = (ty > camera[layout.Y_MIN]) & (ty < camera[layout.Y_MAX])
    gjx = select(free_x, inverse2 * dot(d0, m2), 0.0)
    gjy = select(free_y, inverse2 * dot(d1, m2), 0.0)
    # d loss / d p, with p the centre in the camera's frame.
    gpx = rz * (camera[layout.FX] * gmx - gjx)
    gpy = rz * (camera[layout.FY] * gmy - gjy)
    gpz = zero - tx * gpx - ty * gpy - rz * turning + f[layout.SUM_DEPTH]

    # d loss / d R = rotation^T (d0, d1, d2).
    dr = (
        *_turned_back(camera, 0, d0, d1, d2),
        *_turned_back(camera, 1, d0, d1, d2),
        *_turned_back(camera, 2, d0, d1, d2),
    )
    # Of the unit quaternion, then of that given: without what is along it, over its length.
    gw, gx, gy, gz = _quaternion_gradient(w, qx, qy, qz, dr)
    along = inverse2 * (w * gw + (qx * gx + (qy * gy + qz * gz)))
    inverse = inverse2 * power

    # Culled lanes hold nan: select, do not multiply by zero.
    drawn = load(keys, at) >= 0
    # d loss / d mu = R^T d loss / d p.
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
    store_columns(grad_scales, 3 * at, _keep(drawn, by(inverse2 * rz, gs)))
    # d loss / d o = sum g / o.
    store(grad_opacities, at, select(drawn, f[layout.SUM] / load(opacities, at), 0.0))
    gc = (f[layout.SUM_COLOR], f[layout.SUM_COLOR + 1], f[layout.SUM_COLOR + 2])
    store_columns(grad_colors, 3 * at, _keep(drawn, gc))
    store_columns(grad_means2d, 2 * at, (select(drawn, gmx, 0.0), select(drawn, gmy, 0.0)))


@kernel(fast_math=True, extras=[constants])
def project_backward(
    worker, control, gaussians, camera, keys, numbering, touched, rows, sums, grads
):
    """Reduce the rows of all Gaussians in fixed order and turn them into gradients.

    Args:
        worker, control: See `thread_pool.launch`; a job is a chunk of Gaussians.
        gaussians, camera, keys: As in `project_chunk`.
        numbering: (first row of each Gaussian in its chunk, first row of each chunk and the end).
        touched: Whether a row was written.
        rows: Sums over the pixels of a tile. Without any, ``sums`` are taken as they are.
        sums: Scratch, 16 * LANES per worker; without rows, 16 for each Gaussian.
        grads: (means, quats, scales, opacities, colors, means2d), written.
    """
    n, chunks = keys.size, numbering[1].size - 1
    scratch = layout.RECORD * LANES * worker
    chunk = draw(control, 0)
    while chunk < chunks:
        first, last = chunk_range(chunk, chunks, n)
        for i in range(first, last, LANES):
            at = min(i, last - LANES)
            place = layout.RECORD * at
            if rows.size > 0:
                place = scratch
                for lane in range(LANES):
                    row, end = _rows_of(at + lane, last, chunk, numbering)
                    total = _sum_rows(row, end, touched, rows, _splat_row(0.0))
                    store(sums, place + layout.RECORD * lane, total)
            _backward_group(at, sums, place, gaussians, camera, keys, grads)
        chunk = draw(control, 0)
