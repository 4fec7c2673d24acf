"""Gradients of the deformation, compiled.

Gaussians with a gradient, those that a view shows, are gathered into blocks. Their gradients with
respect to planes and weights are added up part by part, always in the same order.
"""

from __future__ import annotations

from numpy import float32

from baselines.deformation_4dgs.field.forward import (
    ONE,
    REST,
    ZERO,
    between,
    bilinear,
    coordinate,
    find_cell,
    gather_features,
    hidden_layers,
)
from baselines.deformation_4dgs.field.layout import BLOCK, COLORS, SMALL
from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.layers import add_column_sums, keep_active, sum_parts
from chronoscene.kernels.matmul import product
from chronoscene.kernels.memory import (
    load,
    load_first,
    moved,
    read,
    read_index,
    set_zero,
    store,
    store_first,
    write,
    write_index,
)
from chronoscene.kernels.thread_pool import draw, finish, wait_for
from chronoscene.kernels.vector_math import lane_sum
from chronoscene.kernels.vectors import LANES, absolute, splat

SLICE = 1024  # Gradients summed over the parts in one job; multiple of LANES


@inner
def _has_gradient(layout, grads, n):  # type: ignore[no-untyped-def]
    """Return True if a Gaussian has a gradient: it may be out of the image, or behind others."""
    found = layout.opacity and read(grads.logit_opacities, n) != ZERO
    for i in range(3):
        found |= read(grads.means, 3 * n + i) != ZERO
        found |= read(grads.log_scales, 3 * n + i) != ZERO
    for i in range(4):
        found |= read(grads.quats, 4 * n + i) != ZERO
    if layout.color and not found:
        for i in range(3):
            found |= read(grads.sh_dc, 3 * n + i) != ZERO
        for c in range(0, REST, LANES):
            value = load_first(grads.sh_rest, n * REST + c, REST - c)
            found |= lane_sum(absolute(value)) != ZERO
    return found


@inner
def _gather_gradient(layout, grads, n, unit, work, slot):  # type: ignore[no-untyped-def]
    """Write the gradients of the outputs of one Gaussian."""
    at = slot * SMALL
    for i in range(3):
        write(work.small, at + i, unit * read(grads.means, 3 * n + i))
        write(work.small, at + 3 + i, read(grads.log_scales, 3 * n + i))
    for i in range(4):
        write(work.small, at + 6 + i, read(grads.quats, 4 * n + i))
    write(work.small, at + 10, read(grads.logit_opacities, n) if layout.opacity else ZERO)
    for i in range(11, SMALL):
        write(work.small, at + i, ZERO)
    if layout.color:
        at = slot * COLORS
        for i in range(3):
            write(work.colors, at + i, read(grads.sh_dc, 3 * n + i))
        for c in range(0, REST, LANES):
            value = load_first(grads.sh_rest, n * REST + c, REST - c)
            store_first(work.colors, at + 3 + c, value, REST - c)


@inner
def _layer_gradients(layout, weights, work, partial):  # type: ignore[no-untyped-def]
    """From the outputs of a block to its features, and to the weights on the way."""
    width, hiddens, small = layout.width_pad, layout.hiddens, layout.small
    zeros, hidden = (weights.zeros, 0, 0), (work.hidden, 0, hiddens)
    d_hidden = (work.d_hidden, 0, hiddens)

    d_weight = (partial.small, 0, small)
    product((work.small, 0, 1, SMALL), hidden, d_weight, d_weight, SMALL, small, BLOCK)
    add_column_sums(work.small, 0, BLOCK, SMALL, partial.small_bias, 0)
    weight = (weights.small, 0, small)
    product((work.small, 0, SMALL, 1), weight, zeros, d_hidden, BLOCK, small, SMALL)
    if layout.color:
        d_weight, right = (partial.color, 0, width), (work.hidden, small, hiddens)
        product((work.colors, 0, 1, COLORS), right, d_weight, d_weight, COLORS, width, BLOCK)
        add_column_sums(work.colors, 0, BLOCK, COLORS, partial.color_bias, 0)
        weight, out = (weights.color, 0, width), (work.d_hidden, small, hiddens)
        product((work.colors, 0, COLORS, 1), weight, zeros, out, BLOCK, width, COLORS)
    keep_active(work.hidden, 0, work.d_hidden, BLOCK * hiddens)

    d_weight = (partial.hidden_t, 0, hiddens)
    product((work.trunk, 0, 1, width), d_hidden, d_weight, d_weight, width, hiddens, BLOCK)
    add_column_sums(work.d_hidden, 0, BLOCK, hiddens, partial.hidden_bias, 0)
    d_trunk, weight = (work.d_trunk, 0, width), (weights.hidden, 0, width)
    product((work.d_hidden, 0, hiddens, 1), weight, zeros, d_trunk, BLOCK, width, hiddens)
    keep_active(work.trunk, 0, work.d_trunk, BLOCK * width)

    d_weight, columns = (partial.trunk_t, 0, width), layout.features_pad
    product((work.x, 0, 1, columns), d_trunk, d_weight, d_weight, columns, width, BLOCK)
    add_column_sums(work.d_trunk, 0, BLOCK, width, partial.trunk_bias, 0)
    weight = (weights.trunk, 0, columns)
    product(
        (work.d_trunk, 0, width, 1), weight, zeros, (work.d_x, 0, columns), BLOCK, columns, width
    )


@inlined
def _add(memory, at, value):  # type: ignore[no-untyped-def]
    store(memory, at, load(memory, at) + value)


@inlined
def _spread(memory, at, right, down, fx, fy, grad):  # type: ignore[no-untyped-def]
    """Add a gradient to four cells of a plane, as `bilinear` reads them."""
    lower = fy * grad
    upper = grad - lower
    _add(memory, at, upper - fx * upper)
    _add(memory, at + right, fx * upper)
    _add(memory, at + down, lower - fx * lower)
    _add(memory, at + down + right, fx * lower)


@inlined
def _spread_line(memory, at, right, fx, grad):  # type: ignore[no-untyped-def]
    """Add a gradient to two cells of a line."""
    _add(memory, at, grad - fx * grad)
    _add(memory, at + right, fx * grad)


@inlined
def _slope(memory, at, right):  # type: ignore[no-untyped-def]
    """Derivative of `between`, per cell."""
    return load(memory, at + right) - load(memory, at)


@inlined
def _slope_along(memory, at, along, across, share):  # type: ignore[no-untyped-def]
    """Derivative of `bilinear` per cell along one axis, with the share of the next cell on the
    other; the distances of the next cells on both."""
    near = _slope(memory, at, along)
    return near + share * (_slope(memory, at + across, along) - near)


@inner
def _slope_to_mean(planes, axis, value, size, slope):  # type: ignore[no-untyped-def]
    """Gradient of a coordinate of the mean from that per cell; 0 at the border and outside."""
    if value > ZERO and value < ONE:
        return slope * float32(size - 1) * read(planes.box, 3 + axis)
    return ZERO


@inner
def _plane_gradients(layout, planes, means, n, slot, d_x, partial, out):  # type: ignore[no-untyped-def]
    """From the features of a Gaussian to the planes, and to its mean."""
    step = layout.channels
    ux, uy = coordinate(planes, means, n, 0), coordinate(planes, means, n, 1)
    uz = coordinate(planes, means, n, 2)
    values, grads = planes.values, partial.planes
    for level in range(layout.levels):
        size = read_index(planes.sizes, level)
        ix, fx = find_cell(ux, size)
        iy, fy = find_cell(uy, size)
        iz, fz = find_cell(uz, size)
        row, area = size * step, size * size * step
        start = read_index(planes.starts, level)
        sx = sy = sz = splat(ZERO)
        for c in range(0, step, LANES):
            at_xy = start + iy * row + ix * step + c
            at_xz = start + area + iz * row + ix * step + c
            at_yz = start + 2 * area + iz * row + iy * step + c
            at_x = start + 3 * area + ix * step + c
            at_y = start + 3 * area + row + iy * step + c
            at_z = start + 3 * area + 2 * row + iz * step + c
            xy = bilinear(values, at_xy, step, row, fx, fy)
            xz = bilinear(values, at_xz, step, row, fx, fz)
            yz = bilinear(values, at_yz, step, row, fy, fz)
            x, y = between(values, at_x, step, fx), between(values, at_y, step, fy)
            z = between(values, at_z, step, fz)
            # Lanes beyond the channels are 0, so that nothing is added to the next cell.
            grad = load_first(d_x, slot * layout.features_pad + level * step + c, step - c)
            lines, patches = grad * x * y * z, grad * xy * xz * yz
            d_xy, d_xz, d_yz = lines * xz * yz, lines * xy * yz, lines * xy * xz
            d_x_line, d_y_line, d_z_line = patches * y * z, patches * x * z, patches * x * y
            sx = sx + d_xy * _slope_along(values, at_xy, step, row, fy)
            sx = sx + d_xz * _slope_along(values, at_xz, step, row, fz)
            sx = sx + d_x_line * _slope(values, at_x, step)
            sy = sy + d_xy * _slope_along(values, at_xy, row, step, fx)
            sy = sy + d_yz * _slope_along(values, at_yz, step, row, fz)
            sy = sy + d_y_line * _slope(values, at_y, step)
            sz = sz + d_xz * _slope_along(values, at_xz, row, step, fx)
            sz = sz + d_yz * _slope_along(values, at_yz, row, step, fy)
            sz = sz + d_z_line * _slope(values, at_z, step)
            _spread(grads, at_xy, step, row, fx, fy, d_xy)
            _spread(grads, at_xz, step, row, fx, fz, d_xz)
            _spread(grads, at_yz, step, row, fy, fz, d_yz)
            _spread_line(grads, at_x, step, fx, d_x_line)
            _spread_line(grads, at_y, step, fy, d_y_line)
            _spread_line(grads, at_z, step, fz, d_z_line)
        gx = _slope_to_mean(planes, 0, ux, size, lane_sum(sx))
        gy = _slope_to_mean(planes, 1, uy, size, lane_sum(sy))
        gz = _slope_to_mean(planes, 2, uz, size, lane_sum(sz))
        write(out, 3 * n, read(out, 3 * n) + gx)
        write(out, 3 * n + 1, read(out, 3 * n + 1) + gy)
        write(out, 3 * n + 2, read(out, 3 * n + 2) + gz)


@inner
def _block_gradient(layout, planes, weights, means, grads, count, unit, work, partial, out):  # type: ignore[no-untyped-def]
    """Gradients from the Gaussians in the first rows of the work space."""
    for i in range(count):
        n = read_index(work.rows, i)
        gather_features(layout, planes, means, n, work.x, i)
        _gather_gradient(layout, grads, n, unit, work, i)
    set_zero(work.small, count * SMALL, BLOCK * SMALL)
    if layout.color:
        set_zero(work.colors, count * COLORS, BLOCK * COLORS)
    hidden_layers(layout, weights, work)
    _layer_gradients(layout, weights, work, partial)
    for i in range(count):
        n = read_index(work.rows, i)
        _plane_gradients(layout, planes, means, n, i, work.d_x, partial, out)


@inner
def _part_gradient(  # type: ignore[no-untyped-def]
    layout, planes, weights, means, grads, begin, end, unit, work, partial, out
):
    """Gaussians begin..end, those with a gradient gathered into blocks."""
    found = 0
    for n in range(begin, end):
        if _has_gradient(layout, grads, n):
            write_index(work.rows, found, n)
            found += 1
        if found == BLOCK or (n == end - 1 and found):
            _block_gradient(layout, planes, weights, means, grads, found, unit, work, partial, out)
            found = 0


@kernel
def deform_backward(  # type: ignore[no-untyped-def]
    number,
    control,
    layout,
    planes,
    weights,
    means,
    grads,
    count,
    rows,
    unit,
    out,
    partial,
    partial_size,
    work,
    size,
):
    """Gradients of what `deform_forward` reads; arguments as there, and these.

    Args:
        means: Address of the parameters of this name.
        grads: `Gaussians`, gradients of the outputs.
        rows: Gaussians of each partial sum.
        out: Address of the gradient of the means, that of the outputs at first; the way through
            the planes is added.
        partial: `Gradients` of the first part, in the end of all; those of other parts follow.
        partial_size: Numbers in it.
    """
    own, parts = moved(work, number * size), max(1, (count + rows - 1) // rows)
    part = draw(control, 0)
    while part < parts:
        sums = moved(partial, part * partial_size)
        set_zero(sums.planes, 0, partial_size)
        begin, end = part * rows, min((part + 1) * rows, count)
        _part_gradient(layout, planes, weights, means, grads, begin, end, unit, own, sums, out)
        finish(control, 0)
        part = draw(control, 0)
    wait_for(control, 0, parts)
    begin = SLICE * draw(control, 1)
    while begin < partial_size:
        end = min(begin + SLICE, partial_size)
        sum_parts(partial.planes, parts, partial_size, begin, end)
        begin = SLICE * draw(control, 1)
