"""Deform Gaussians, compiled: blocks of rows sample the planes and go through the layers."""

from __future__ import annotations

from numpy import float32

from baselines.deformation_4dgs.field.layout import BLOCK, COLORS, SMALL
from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.matmul import product, relu_product
from chronoscene.kernels.memory import (
    load,
    load_first,
    moved,
    read,
    read_index,
    store,
    store_first,
    write,
)
from chronoscene.kernels.thread_pool import draw
from chronoscene.kernels.vectors import LANES

ZERO = float32(0)
ONE = float32(1)
REST = COLORS - 3  # Coefficients of a Gaussian above the constant ones


@inner
def coordinate(planes, means, n, axis):  # type: ignore[no-untyped-def]
    """Position of a Gaussian in the box, 0..1 within it."""
    return (read(means, 3 * n + axis) - read(planes.box, axis)) * read(planes.box, 3 + axis)


@inner
def find_cell(value, size):  # type: ignore[no-untyped-def]
    """Cell that a coordinate is in, and how far towards the next."""
    # What is not a number goes to the border: the result is not a number anyway.
    inside = min(value, ONE) if value > ZERO else ZERO
    scaled = inside * float32(size - 1)
    cell = min(int(scaled), size - 2)
    return cell, scaled - float32(cell)


@inlined
def bilinear(memory, at, right, down, fx, fy):  # type: ignore[no-untyped-def]
    """Between four cells of a plane."""
    a, b = load(memory, at), load(memory, at + right)
    c, d = load(memory, at + down), load(memory, at + down + right)
    top = a + fx * (b - a)
    return top + fy * (c + fx * (d - c) - top)


@inlined
def between(memory, at, right, fx):  # type: ignore[no-untyped-def]
    """Between two cells of a line."""
    a = load(memory, at)
    return a + fx * (load(memory, at + right) - a)


@inner
def gather_features(layout, planes, means, n, x, slot):  # type: ignore[no-untyped-def]
    """Write the features of a Gaussian: per level the product of three planes and three lines."""
    step = layout.channels
    ux, uy = coordinate(planes, means, n, 0), coordinate(planes, means, n, 1)
    uz = coordinate(planes, means, n, 2)
    for level in range(layout.levels):
        size = read_index(planes.sizes, level)
        ix, fx = find_cell(ux, size)
        iy, fy = find_cell(uy, size)
        iz, fz = find_cell(uz, size)
        row, area = size * step, size * size * step
        xy = read_index(planes.starts, level)
        line = xy + 3 * area
        xz, yz = xy + area + iz * row + ix * step, xy + 2 * area + iz * row + iy * step
        xy = xy + iy * row + ix * step
        # A store may run over into what comes next, which is written later.
        for c in range(0, step, LANES):
            value = bilinear(planes.values, xy + c, step, row, fx, fy)
            value = value * bilinear(planes.values, xz + c, step, row, fx, fz)
            value = value * bilinear(planes.values, yz + c, step, row, fy, fz)
            value = value * between(planes.values, line + ix * step + c, step, fx)
            value = value * between(planes.values, line + row + iy * step + c, step, fy)
            value = value * between(planes.values, line + 2 * row + iz * step + c, step, fz)
            store(x, slot * layout.features_pad + level * step + c, value)


@inner
def hidden_layers(layout, weights, work):  # type: ignore[no-untyped-def]
    """Trunk, and the hidden layers of all heads, for a block."""
    inputs = (work.x, 0, layout.features_pad, 1)
    right = (weights.trunk_t, 0, layout.width_pad)
    out, bias = (work.trunk, 0, layout.width_pad), (weights.trunk_bias, 0, 0)
    relu_product(inputs, right, bias, out, BLOCK, layout.width_pad, layout.features)
    left = (work.trunk, 0, layout.width_pad, 1)
    right = (weights.hidden_t, 0, layout.hiddens)
    out, bias = (work.hidden, 0, layout.hiddens), (weights.hidden_bias, 0, 0)
    relu_product(left, right, bias, out, BLOCK, layout.hiddens, layout.width)


@inner
def _output_layers(layout, weights, work):  # type: ignore[no-untyped-def]
    left = (work.hidden, 0, layout.hiddens, 1)
    right, bias = (weights.small_t, 0, SMALL), (weights.small_bias, 0, 0)
    product(left, right, bias, (work.small, 0, SMALL), BLOCK, SMALL, layout.small)
    if layout.color:
        left = (work.hidden, layout.small, layout.hiddens, 1)
        right, bias = (weights.color_t, 0, COLORS), (weights.color_bias, 0, 0)
        product(left, right, bias, (work.colors, 0, COLORS), BLOCK, COLORS, layout.width)


@inner
def _add_row(layout, source, work, slot, n, unit, out):  # type: ignore[no-untyped-def]
    """Deformed parameters of one Gaussian."""
    at = slot * SMALL
    for i in range(3):
        write(out.means, 3 * n + i, read(source.means, 3 * n + i) + unit * read(work.small, at + i))
        scale = read(source.log_scales, 3 * n + i) + read(work.small, at + 3 + i)
        write(out.log_scales, 3 * n + i, scale)
    for i in range(4):
        write(out.quats, 4 * n + i, read(source.quats, 4 * n + i) + read(work.small, at + 6 + i))
    if layout.opacity:
        logit = read(source.logit_opacities, n) + read(work.small, at + 10)
        write(out.logit_opacities, n, logit)
    if layout.color:
        at = slot * COLORS
        for i in range(3):
            write(out.sh_dc, 3 * n + i, read(source.sh_dc, 3 * n + i) + read(work.colors, at + i))
        for c in range(0, REST, LANES):
            left, first = REST - c, n * REST + c
            value = load_first(source.sh_rest, first, left)
            value = value + load_first(work.colors, at + 3 + c, left)
            store_first(out.sh_rest, first, value, left)


@kernel
def deform_forward(number, control, layout, planes, weights, source, count, unit, out, work, size):  # type: ignore[no-untyped-def]
    """Deform ``count`` Gaussians.

    Args:
        number: Of the worker.
        control: Counters that jobs are drawn from; see `chronoscene.kernels.thread_pool`.
        unit: What offsets of positions are multiplied by. float32
        out: `Gaussians`, written.
        work: `Work` of the first worker, finite numbers.
        size: Numbers in it.
    """
    own = moved(work, number * size)
    begin = BLOCK * draw(control, 0)
    while begin < count:
        rows = min(BLOCK, count - begin)
        for i in range(rows):
            gather_features(layout, planes, source.means, begin + i, own.x, i)
        hidden_layers(layout, weights, own)
        _output_layers(layout, weights, own)
        for i in range(rows):
            _add_row(layout, source, own, i, begin + i, unit, out)
        begin = BLOCK * draw(control, 0)
