"""Kernels of `spherical_harmonics`, for `LANES` Gaussians at a time: colours and their gradients.

Each number of these Gaussians is a vector; triples of vectors are coordinates or channels. Arrays
are flat float32, of at least `LANES` Gaussians.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

from numba import prange, types
from numba.core import cgutils

from chronoscene.kernels import vectors
from chronoscene.kernels.compilation import FAST_MATH, inlined, inner, kernel
from chronoscene.kernels.transposes import (
    make_load_columns,
    make_load_some_columns,
    store_columns,
    store_some_columns,
)
from chronoscene.kernels.vectors import (
    FLOAT,
    LANES,
    absolute,
    any_lane,
    emit_lanes,
    emit_multiply_add,
    emitted,
    maximum,
    select,
    splat,
)

# The normalisation of each polynomial; named after degree and order.
C0 = 0.5 * sqrt(1 / pi)
C1 = 0.5 * sqrt(3 / pi)
C2_XY = 0.5 * sqrt(15 / pi)
C2_ZZ = 0.25 * sqrt(5 / pi)
C2_XX = 0.25 * sqrt(15 / pi)
C3_3 = 0.25 * sqrt(35 / (2 * pi))
C3_2 = 0.5 * sqrt(105 / pi)
C3_1 = 0.25 * sqrt(21 / (2 * pi))
C3_0 = 0.25 * sqrt(7 / pi)
C3_22 = 0.25 * sqrt(105 / pi)

ROW = 45  # Coefficients of a Gaussian beside the constant ones: 15 for each channel
BLOCK = 512  # Gaussians that one task handles

_load_triples = make_load_columns(3, LANES)
_load_degree_1 = make_load_some_columns(9, LANES)
_load_degree_2 = make_load_some_columns(24, LANES)
_load_degree_3 = make_load_some_columns(45, LANES)


@inlined
def _basis_1(x, y, z):  # type: ignore[no-untyped-def]
    return -C1 * y, C1 * z, -C1 * x


@inlined
def _basis_2(x, y, z):  # type: ignore[no-untyped-def]
    xx, yy, zz = x * x, y * y, z * z
    return (
        *_basis_1(x, y, z),
        C2_XY * x * y,
        -C2_XY * y * z,
        C2_ZZ * (2.0 * zz - xx - yy),
        -C2_XY * x * z,
        C2_XX * (xx - yy),
    )


@inlined
def _basis_3(x, y, z):  # type: ignore[no-untyped-def]
    xx, yy, zz = x * x, y * y, z * z
    return (
        *_basis_2(x, y, z),
        -C3_3 * y * (3.0 * xx - yy),
        C3_2 * x * y * z,
        -C3_1 * y * (4.0 * zz - xx - yy),
        C3_0 * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        -C3_1 * x * (4.0 * zz - xx - yy),
        C3_22 * z * (xx - yy),
        -C3_3 * x * (xx - 3.0 * yy),
    )


# Gradients of ``sum_k s[k] * basis_k`` with respect to the direction, taken as free of |d| = 1.


@inlined
def _slope_1(x, y, z, s):  # type: ignore[no-untyped-def]
    return -C1 * s[2], -C1 * s[0], C1 * s[1]


@inlined
def _slope_2(x, y, z, s):  # type: ignore[no-untyped-def]
    gx, gy, gz = _slope_1(x, y, z, s)
    gx = gx + C2_XY * (y * s[3] - z * s[6]) - 2 * C2_ZZ * x * s[5] + 2 * C2_XX * x * s[7]
    gy = gy + C2_XY * (x * s[3] - z * s[4]) - 2 * C2_ZZ * y * s[5] - 2 * C2_XX * y * s[7]
    gz = gz - C2_XY * (y * s[4] + x * s[6]) + 4 * C2_ZZ * z * s[5]
    return gx, gy, gz


@inlined
def _slope_3(x, y, z, s):  # type: ignore[no-untyped-def]
    gx, gy, gz = _slope_2(x, y, z, s)
    xx, yy, zz = x * x, y * y, z * z
    gx = gx - 6 * C3_3 * x * y * s[8] + C3_2 * y * z * s[9] + 2 * C3_1 * x * y * s[10]
    gx = gx - 6 * C3_0 * x * z * s[11] - C3_1 * (4.0 * zz - 3.0 * xx - yy) * s[12]
    gx = gx + 2 * C3_22 * x * z * s[13] - 3 * C3_3 * (xx - yy) * s[14]
    gy = gy - 3 * C3_3 * (xx - yy) * s[8] + C3_2 * x * z * s[9]
    gy = gy - C3_1 * (4.0 * zz - xx - 3.0 * yy) * s[10] - 6 * C3_0 * y * z * s[11]
    gy = gy + 2 * C3_1 * x * y * s[12] - 2 * C3_22 * y * z * s[13] + 6 * C3_3 * x * y * s[14]
    gz = gz + C3_2 * x * y * s[9] - 8 * C3_1 * z * (y * s[10] + x * s[12])
    gz = gz + C3_0 * (6.0 * zz - 3.0 * xx - 3.0 * yy) * s[11] + C3_22 * (xx - yy) * s[13]
    return gx, gy, gz


@emitted(lambda values, coeffs, start: start(values, coeffs, start))
def _add_channels(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Add, for each channel, the sum over k of ``values[k] * coeffs[3 k + channel]``."""
    values, coeffs, totals = (
        cgutils.unpack_tuple(builder, value, len(kind))
        for kind, value in zip(sig.args, args, strict=True)
    )
    for i, coeff in enumerate(coeffs):
        totals[i % 3] = emit_multiply_add(builder, values[i // 3], coeff, totals[i % 3])
    return context.make_tuple(builder, sig.return_type, totals)


@emitted(lambda coeffs, grads: types.UniTuple(grads[0], len(coeffs) // 3)(coeffs, grads))
def _sum_channels(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Sum ``coeffs[3 k + channel] * grads[channel]`` over the channels, for each k."""
    coeffs = cgutils.unpack_tuple(builder, args[0], len(sig.args[0]))
    r, g, b = cgutils.unpack_tuple(builder, args[1], 3)
    sums = []
    for k in range(0, len(coeffs), 3):
        total = builder.fmul(b, coeffs[k + 2], flags=FAST_MATH)
        total = emit_multiply_add(builder, g, coeffs[k + 1], total)
        sums.append(emit_multiply_add(builder, r, coeffs[k], total))
    return context.make_tuple(builder, sig.return_type, sums)


@emitted(lambda values, grads: types.UniTuple(grads[0], ROW)(values, grads))
def _products(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """``values[k] * grads[channel]`` as the gradients of a row; zeros for higher degrees."""
    values = cgutils.unpack_tuple(builder, args[0], len(sig.args[0]))
    grads = cgutils.unpack_tuple(builder, args[1], 3)
    row = [builder.fmul(value, grad, flags=FAST_MATH) for value in values for grad in grads]
    row += [emit_lanes([0.0] * LANES, FLOAT)] * (ROW - len(row))
    return context.make_tuple(builder, sig.return_type, row)


@inlined
def _normalised(x, y, z):  # type: ignore[no-untyped-def]
    """Unit vectors, and 1 over the lengths; a length of 0 counts as tiny."""
    inverse = 1.0 / vectors.sqrt(maximum(x * x + (y * y + z * z), 1e-24))
    return (x * inverse, y * inverse, z * inverse), inverse


@inlined
def _offsets(at, means, centre):  # type: ignore[no-untyped-def]
    x, y, z = _load_triples(means, 3 * at)
    return x - centre[0], y - centre[1], z - centre[2]


@inlined
def _color_group(at, sh_dc, sh_rest, means, centre, degree, colors):  # type: ignore[no-untyped-def]
    """Write the colours of Gaussians at..at+LANES."""
    r, g, b = _load_triples(sh_dc, 3 * at)
    sums = C0 * r + 0.5, C0 * g + 0.5, C0 * b + 0.5
    if degree > 0:
        x, y, z = _offsets(at, means, centre)
        (x, y, z), _ = _normalised(x, y, z)
        if degree == 1:
            sums = _add_channels(_basis_1(x, y, z), _load_degree_1(sh_rest, ROW * at, ROW), sums)
        elif degree == 2:
            sums = _add_channels(_basis_2(x, y, z), _load_degree_2(sh_rest, ROW * at, ROW), sums)
        else:
            sums = _add_channels(_basis_3(x, y, z), _load_degree_3(sh_rest, ROW * at, ROW), sums)
    # The second of the two where one is nan, so that it stays.
    r, g, b = maximum(0.0, sums[0]), maximum(0.0, sums[1]), maximum(0.0, sums[2])
    store_columns(colors, 3 * at, (r, g, b))


@inlined
def _gradient_group(at, inputs, colors, grad_colors, results):  # type: ignore[no-untyped-def]
    """Write the gradients of Gaussians at..at+LANES."""
    sh_rest, means, centre, degree = inputs
    grad_dc, grad_rest, grad_means = results
    zero = splat(0.0)
    r, g, b = _load_triples(colors, 3 * at)
    grads = _load_triples(grad_colors, 3 * at)
    # A colour that was cut at 0 has no gradient.
    r, g = select(r > 0.0, grads[0], zero), select(g > 0.0, grads[1], zero)
    grads = r, g, select(b > 0.0, grads[2], zero)
    store_columns(grad_dc, 3 * at, (C0 * grads[0], C0 * grads[1], C0 * grads[2]))
    some = (absolute(grads[0]) + (absolute(grads[1]) + absolute(grads[2]))) > 0.0
    if degree == 0 or not any_lane(some):
        store_some_columns(grad_rest, ROW * at, ROW, _products((), grads))
        store_columns(grad_means, 3 * at, (zero, zero, zero))
        return
    x, y, z = _offsets(at, means, centre)
    # Where nothing comes in, nothing comes out, even if the Gaussian is not finite.
    x, y, z = select(some, x, zero), select(some, y, zero), select(some, z, zero)
    (x, y, z), inverse = _normalised(x, y, z)
    if degree == 1:
        sums = _sum_channels(_load_degree_1(sh_rest, ROW * at, ROW), grads)
        row, slope = _products(_basis_1(x, y, z), grads), _slope_1(x, y, z, sums)
    elif degree == 2:
        sums = _sum_channels(_load_degree_2(sh_rest, ROW * at, ROW), grads)
        row, slope = _products(_basis_2(x, y, z), grads), _slope_2(x, y, z, sums)
    else:
        sums = _sum_channels(_load_degree_3(sh_rest, ROW * at, ROW), grads)
        row, slope = _products(_basis_3(x, y, z), grads), _slope_3(x, y, z, sums)
    store_some_columns(grad_rest, ROW * at, ROW, row)
    gx, gy, gz = slope
    along = gx * x + (gy * y + gz * z)
    gx, gy, gz = gx - along * x, gy - along * y, gz - along * z
    gx, gy, gz = select(some, gx, zero), select(some, gy, zero), select(some, gz, zero)
    store_columns(grad_means, 3 * at, (gx * inverse, gy * inverse, gz * inverse))


@inner
def _task(number, tasks, count):  # type: ignore[no-untyped-def]
    """Return the first Gaussian of a task and the end: the last task has the remainder."""
    first = number * BLOCK
    return first, count if number == tasks - 1 else first + BLOCK


@kernel(parallel=True)
def write_colors(sh_dc, sh_rest, means, centre, degree, colors):  # type: ignore[no-untyped-def]
    """Write the colours of Gaussians as seen from ``centre``, by harmonics up to ``degree``."""
    count = len(means) // 3
    tasks = max(count // BLOCK, 1)
    for number in prange(tasks):
        first, end = _task(number, tasks, count)
        for at in range(first, end, LANES):
            # The last Gaussians of a task are done with some of those before them.
            _color_group(min(at, end - LANES), sh_dc, sh_rest, means, centre, degree, colors)


@kernel(parallel=True)
def write_gradients(  # type: ignore[no-untyped-def]
    sh_rest, means, centre, degree, colors, grad_colors, grad_dc, grad_rest, grad_means
):
    """Write the gradients of what `write_colors` made ``colors`` of."""
    count = len(means) // 3
    tasks = max(count // BLOCK, 1)
    inputs, results = (sh_rest, means, centre, degree), (grad_dc, grad_rest, grad_means)
    for number in prange(tasks):
        first, end = _task(number, tasks, count)
        for at in range(first, end, LANES):
            _gradient_group(min(at, end - LANES), inputs, colors, grad_colors, results)
