"""Decode anchors, compiled: blocks of anchors through the joined heads.

Two passes. The first finds the opacities, and so which Gaussians are active and where in the output
they go; the second decodes the shapes and colours of anchors that have an active Gaussian.
"""

from __future__ import annotations

import math

from numba import prange
from numpy import float32

from chronoscene.anchors.decode.layout import BLOCK, CHUNK, MIN_DISTANCE, MIN_QUAT_NORM
from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.matmul import ROW_TILE, product, relu_product
from chronoscene.kernels.memory import (
    copy_quad,
    load,
    load_first,
    moved,
    prefetch,
    read,
    read_index,
    store,
    store_first,
    write,
    write_index,
)
from chronoscene.kernels.vector_math import exp, quad_heads, quad_sum, sigmoid, tanh
from chronoscene.kernels.vectors import LANES, make_constant, select, splat, sqrt

_identity = make_constant([1.0, 0.0, 0.0, 0.0] * (LANES // 4))
"""The quaternion without a turn, over and over."""
AHEAD = 16  # Anchors between the request for a row and its use
ZERO = float32(0)
ONE = float32(1)
_MIN_DISTANCE = float32(MIN_DISTANCE)
_MIN_SQUARE = float32(MIN_QUAT_NORM**2)


@inner
def _prefetch_inputs(layout, source, m):  # type: ignore[no-untyped-def]
    """Ask for the features of a later anchor: its row is far from those before."""
    if m < source.num_visible:
        anchor = read_index(source.visible, m)
        prefetch(source.features, anchor * layout.base)
        for s in range(source.num_periods):
            prefetch(source.blocks, block_start(layout, source, anchor, s))


@inner
def block_start(layout, source, anchor, s):  # type: ignore[no-untyped-def]
    """Return the first number of an anchor's block of the s-th period that is mixed in."""
    at = anchor * source.all_periods + read_index(source.periods, s)
    return read_index(source.block_rows, at) * layout.period


@inner
def gather_inputs(layout, source, m, x, slot):  # type: ignore[no-untyped-def]
    """Write the input of the heads: base feature, mixed period feature, unit direction."""
    _prefetch_inputs(layout, source, m + AHEAD)
    anchor, at = read_index(source.visible, m), slot * layout.inputs_pad
    row = anchor * layout.base
    for c in range(0, layout.base, LANES):
        store(x, at + c, load_first(source.features, row + c, layout.base - c))
    # A store may run over into what comes next, which is written later.
    for c in range(0, layout.period, LANES):
        total = splat(ZERO)
        for s in range(source.num_periods):
            start = block_start(layout, source, anchor, s) + c
            part = load_first(source.blocks, start, layout.period - c)
            total = total + read(source.weights, s) * part
        store(x, at + layout.base + c, total)
    dx = read(source.anchors, 3 * anchor) - read(source.centre, 0)
    dy = read(source.anchors, 3 * anchor + 1) - read(source.centre, 1)
    dz = read(source.anchors, 3 * anchor + 2) - read(source.centre, 2)
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    over = ONE / length if length > _MIN_DISTANCE else ZERO
    write(x, at + layout.features, dx * over)
    write(x, at + layout.features + 1, dy * over)
    write(x, at + layout.features + 2, dz * over)
    for c in range(layout.inputs, layout.inputs_pad):
        write(x, at + c, ZERO)


@inner
def tiled(count):  # type: ignore[no-untyped-def]
    """Return the rows that matrix products need for so many."""
    return (count + ROW_TILE - 1) // ROW_TILE * ROW_TILE


@inner
def hidden_layer(layout, weights, work, count, first, columns):  # type: ignore[no-untyped-def]
    """Compute the first layer of some heads for ``count`` anchors of a block."""
    right = (weights.w1_t, first, layout.hiddens)
    bias = (weights.b1, first, 0)
    out = (work.hidden, first, layout.hiddens)
    inputs, rows = layout.inputs, tiled(count)
    relu_product((work.x, 0, layout.inputs_pad, 1), right, bias, out, rows, columns, inputs)


@inner
def _output_layer(layout, weights, work, count, head, first, columns):  # type: ignore[no-untyped-def]
    """Compute the second layer of a head for ``count`` anchors of a block: ``columns`` outputs from
    ``first`` on."""
    left = (work.hidden, head * layout.hidden_pad, layout.hiddens, 1)
    right = (weights.w2_t, first, layout.outputs_pad)
    out = (work.raw, first, layout.outputs_pad)
    product(left, right, (weights.b2, first, 0), out, tiled(count), columns, layout.hidden)


@inner
def _count_row(raw, at, count, m, used, above, out):  # type: ignore[no-untyped-def]
    """Write the opacities tanh(o) of an anchor, and the number of its active Gaussians.

    ``used`` are the bits of its offsets.
    """
    first = m * count
    for c in range(0, count, LANES):
        store_first(out.alphas, first + c, tanh(load(raw, at + c)), count - c)
    active = 0
    for j in range(first, first + count):
        if not (used >> (j - first)) & 1:
            write(out.alphas, j, -ONE)
        # What is not a number is active, so that it does not go unnoticed.
        active += not (read(out.alphas, j) <= above)
    write_index(out.starts, m + 1, active)


@kernel(parallel=True)
def decode_opacities(layout, weights, source, above, out, work, work_size, tasks):  # type: ignore[no-untyped-def]
    """Do the first pass: opacities of all offsets, and the starts of the anchors.

    Args:
        source: `Anchors`.
        above: Gaussians are active unless their opacity is this or less. float32
        out: `Outputs`, alphas and starts written.
        work: `Work` of the first task, finite numbers.
        work_size: Numbers in it.
        tasks: Into how many tasks to divide the work; does not change the result.
    """
    for task in prange(tasks):
        own = moved(work, task * work_size)
        for begin in range(task * BLOCK, source.num_visible, tasks * BLOCK):
            count = min(BLOCK, source.num_visible - begin)
            for i in range(count):
                gather_inputs(layout, source, begin + i, own.x, i)
            hidden_layer(layout, weights, own, count, 0, layout.hidden_pad)
            _output_layer(layout, weights, own, count, 0, 0, layout.scales_at)
            for i in range(count):
                at = i * layout.outputs_pad
                anchor = read_index(source.visible, begin + i)
                used = read_index(source.used_offsets, anchor)
                _count_row(own.raw, at, layout.offsets, begin + i, used, above, out)
    write_index(out.starts, 0, 0)
    for m in range(source.num_visible):
        total = read_index(out.starts, m) + read_index(out.starts, m + 1)
        write_index(out.starts, m + 1, total)


@inner
def factors(source, anchor, row):  # type: ignore[no-untyped-def]
    """Write exp(log_scales) of an anchor."""
    for c in range(0, 6, LANES):
        store(row, c, exp(load_first(source.log_scales, 6 * anchor + c, 6 - c)))


@inner
def _gather_active(layout, source, m, slot, above, work, done, out):  # type: ignore[no-untyped-def]
    """Put raw outputs of the active Gaussians of an anchor behind those ``done`` before."""
    anchor, raw = read_index(source.visible, m), slot * layout.outputs_pad
    factors(source, anchor, work.row)
    g = read_index(out.starts, m)
    for j in range(layout.offsets):
        position = m * layout.offsets + j
        opacity = read(out.alphas, position)
        if opacity <= above:
            continue
        write(out.opacities, g, opacity)
        write_index(out.positions, g, position)
        # Four numbers where three are meant: the next ones overwrite the fourth.
        copy_quad(work.factors, 3 * done, work.row, 3)
        copy_quad(work.scales, 3 * done, work.raw, raw + layout.scales_at + 3 * j)
        copy_quad(work.quats, 4 * done, work.raw, raw + layout.quats_at + 4 * j)
        copy_quad(work.colors, 3 * done, work.raw, raw + layout.colors_at + 3 * j)
        # mean = anchor + offset exp(log_scales[0:3])
        for c in range(3):
            offset = read(source.offsets, 3 * (anchor * layout.offsets + j) + c)
            mean = read(source.anchors, 3 * anchor + c) + offset * read(work.row, c)
            write(out.means, 3 * g + c, mean)
        g += 1
        done += 1
    return done


@inner
def _activate(work, count, first, out):  # type: ignore[no-untyped-def]
    """Turn raw outputs of ``count`` Gaussians into those from ``first`` on:

    color = sigmoid(c), scale = sigmoid(s) exp(log_scales[3:6]), quat = q / |q|.
    """
    for c in range(0, 3 * count, LANES):
        left, at = 3 * count - c, 3 * first + c
        store_first(out.colors, at, sigmoid(load(work.colors, c)), left)
        scale = sigmoid(load(work.scales, c)) * load(work.factors, c)
        store_first(out.scales, at, scale, left)
    tiny = splat(_MIN_SQUARE)
    for c in range(0, 4 * count, LANES):
        value = load(work.quats, c)
        square = quad_sum(value * value)
        inverse = select(square < tiny, splat(ZERO), ONE / sqrt(square))
        # Without a direction they become the identity.
        unit = select(square < tiny, _identity(), value * inverse)
        store_first(out.quats, 4 * first + c, unit, 4 * count - c)
        quads = min(count - c // 4, LANES // 4)
        store_first(out.inverse_norms, first + c // 4, quad_heads(inverse), quads)


@inner
def _decode_block(layout, weights, source, count, above, work, out):  # type: ignore[no-untyped-def]
    hidden_layer(layout, weights, work, count, layout.hidden_pad, 2 * layout.hidden_pad)
    scales, colors = layout.scales_at, layout.colors_at
    _output_layer(layout, weights, work, count, 1, scales, colors - scales)
    _output_layer(layout, weights, work, count, 2, colors, layout.outputs_pad - colors)
    done = 0
    for i in range(count):
        m = read_index(work.rows, i)
        done = _gather_active(layout, source, m, i, above, work, done, out)
    _activate(work, done, read_index(out.starts, read_index(work.rows, 0)), out)


@kernel(parallel=True)
def decode_forward(layout, weights, source, above, out, work, work_size, tasks):  # type: ignore[no-untyped-def]
    """Do the second pass: all of the active Gaussians; arguments as `decode_opacities`."""
    for task in prange(tasks):
        own = moved(work, task * work_size)
        for begin in range(task * CHUNK, source.num_visible, tasks * CHUNK):
            end = min(begin + CHUNK, source.num_visible)
            count = 0
            for m in range(begin, end):
                if read_index(out.starts, m) < read_index(out.starts, m + 1):
                    write_index(own.rows, count, m)
                    gather_inputs(layout, source, m, own.x, count)
                    count += 1
                if count == BLOCK or (m == end - 1 and count):
                    _decode_block(layout, weights, source, count, above, own, out)
                    count = 0
