"""Decode anchors, compiled: blocks of anchors through the joined heads."""

from __future__ import annotations

import math
from typing import NamedTuple

from numba import njit, prange
from numpy import float32

from chronoscene.training._decode_layout import BLOCK, CHUNK, CYCLE, Work
from chronoscene.training._matmul import product, relu_product
from chronoscene.training._simd import (
    LANES,
    load,
    load_first,
    multiply_add,
    read,
    read_index,
    select_less,
    splat,
    store,
    store_first,
    write,
)
from chronoscene.training._vector_math import (
    exp,
    quad_heads,
    quad_identity,
    quad_sum,
    sigmoid,
    square_root,
    store_cycle,
    tanh,
)

ZERO = float32(0)
ONE = float32(1)


class Anchors(NamedTuple):
    """Addresses of what is decoded; see `chronoscene.training.decode.decode_reference`."""

    anchors: int
    offsets: int
    features: int
    log_scales: int
    centre: int
    visible: int
    num_visible: int
    periods: int
    """Those of weight other than 0. int64"""
    weights: int
    """Their weights."""
    num_periods: int


class Outputs(NamedTuple):
    """Addresses of what comes out."""

    means: int
    quats: int
    scales: int
    opacities: int
    colors: int
    inverse_norms: int
    """1 / |q| of the quaternions before they were made unit, 0 without a direction. [M k]"""


@njit(nogil=True, error_model="numpy")
def task_work(work, task, size):  # type: ignore[no-untyped-def]
    """Work space of a task; ``size`` numbers after that of the task before."""
    move = 4 * task * size
    return Work(
        work.rows + move,
        work.x + move,
        work.hidden + move,
        work.raw + move,
        work.d_hidden + move,
        work.d_x + move,
        work.cycles + move,
    )


@njit(nogil=True, error_model="numpy")
def gather_inputs(layout, source, anchor, minimum, x, at):  # type: ignore[no-untyped-def]
    """Write the input of the heads: base feature, mixed period feature, unit direction."""
    row = anchor * layout.row
    for c in range(0, layout.base, LANES):
        store(x, at + c, load_first(source.features, row + c, layout.base - c))
    # A store may run over into what comes next, which is written later.
    for c in range(0, layout.period, LANES):
        total = splat(ZERO)
        for s in range(source.num_periods):
            start = row + layout.base + read_index(source.periods, s) * layout.period + c
            part = load_first(source.features, start, layout.period - c)
            total = total + read(source.weights, s) * part
        store(x, at + layout.base + c, total)
    dx = read(source.anchors, 3 * anchor) - read(source.centre, 0)
    dy = read(source.anchors, 3 * anchor + 1) - read(source.centre, 1)
    dz = read(source.anchors, 3 * anchor + 2) - read(source.centre, 2)
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    over = ONE / length if length > minimum else ZERO
    write(x, at + layout.features, dx * over)
    write(x, at + layout.features + 1, dy * over)
    write(x, at + layout.features + 2, dz * over)
    for c in range(layout.inputs, layout.inputs_pad):
        write(x, at + c, ZERO)


@njit(nogil=True, error_model="numpy")
def fill_cycles(source, anchor, cycles):  # type: ignore[no-untyped-def]
    """Repeat exp(log_scales[0:3]), exp(log_scales[3:6]) and the position, CYCLE numbers each."""
    work = 3 * CYCLE
    for c in range(0, 6, LANES):
        store(cycles, work + c, exp(load_first(source.log_scales, 6 * anchor + c, 6 - c)))
    store_cycle(cycles, 0, cycles, work)
    store_cycle(cycles, CYCLE, cycles, work + 3)
    for c in range(3):
        write(cycles, work + c, read(source.anchors, 3 * anchor + c))
    store_cycle(cycles, 2 * CYCLE, cycles, work)


@njit(nogil=True, error_model="numpy")
def hidden_layer(layout, weights, work):  # type: ignore[no-untyped-def]
    """First layer of the three heads for a block."""
    hiddens = layout.hiddens
    relu_product(
        (work.x, 0, layout.inputs_pad, 1),
        (weights.w1_t, 0, hiddens),
        (weights.b1, 0, 0),
        (work.hidden, 0, hiddens),
        BLOCK,
        hiddens,
        layout.inputs,
    )


@njit(nogil=True, error_model="numpy")
def head_columns(layout, head):  # type: ignore[no-untyped-def]
    """First column and number of columns of a head's outputs."""
    if head == 0:
        return 0, layout.scales_at
    if head == 1:
        return layout.scales_at, layout.colors_at - layout.scales_at
    return layout.colors_at, layout.outputs_pad - layout.colors_at


@njit(nogil=True, error_model="numpy")
def _output_layer(layout, weights, work):  # type: ignore[no-untyped-def]
    outputs = layout.outputs_pad
    for head in range(3):
        first, count = head_columns(layout, head)
        product(
            (work.hidden, head * layout.hidden_pad, layout.hiddens, 1),
            (weights.w2_t, first, outputs),
            (weights.b2, first, 0),
            (work.raw, first, outputs),
            BLOCK,
            count,
            layout.hidden,
        )


@njit(nogil=True, error_model="numpy")
def _write_quats(raw, at, count, first, min_square, out):  # type: ignore[no-untyped-def]
    """Make 4-vectors unit; without a direction they become the identity."""
    minimum = splat(min_square)
    for c in range(0, 4 * count, LANES):
        value = load(raw, at + c)
        square = quad_sum(value * value)
        inverse = select_less(square, minimum, splat(ZERO), ONE / square_root(square))
        unit = select_less(square, minimum, quad_identity(), value * inverse)
        store_first(out.quats, 4 * first + c, unit, 4 * count - c)
        quads = min(count - c // 4, LANES // 4)
        store_first(out.inverse_norms, first + c // 4, quad_heads(inverse), quads)


@njit(nogil=True, error_model="numpy")
def _write_row(layout, source, anchor, first, work, at, min_square, out):  # type: ignore[no-untyped-def]
    """Turn the raw outputs of an anchor into Gaussians ``first``, ``first + 1``, ..."""
    count, raw, cycles = layout.offsets, work.raw, work.cycles
    fill_cycles(source, anchor, cycles)
    for c in range(0, count, LANES):
        store_first(out.opacities, first + c, tanh(load(raw, at + c)), count - c)
    _write_quats(raw, at + layout.quats_at, count, first, min_square, out)
    for c in range(0, 3 * count, LANES):
        phase, left = c % CYCLE, 3 * count - c
        color = sigmoid(load(raw, at + layout.colors_at + c))
        store_first(out.colors, 3 * first + c, color, left)
        scale = sigmoid(load(raw, at + layout.scales_at + c)) * load(cycles, CYCLE + phase)
        store_first(out.scales, 3 * first + c, scale, left)
        offset = load_first(source.offsets, 3 * count * anchor + c, left)
        mean = multiply_add(offset, load(cycles, phase), load(cycles, 2 * CYCLE + phase))
        store_first(out.means, 3 * first + c, mean, left)


@njit(nogil=True, error_model="numpy")
def _decode_chunk(layout, weights, source, begin, end, limits, work, out):  # type: ignore[no-untyped-def]
    for start in range(begin, end, BLOCK):
        count = min(BLOCK, end - start)
        for i in range(count):
            anchor = read_index(source.visible, start + i)
            gather_inputs(layout, source, anchor, limits[0], work.x, i * layout.inputs_pad)
        hidden_layer(layout, weights, work)
        _output_layer(layout, weights, work)
        for i in range(count):
            anchor, first = read_index(source.visible, start + i), (start + i) * layout.offsets
            at = i * layout.outputs_pad
            _write_row(layout, source, anchor, first, work, at, limits[1], out)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def decode_forward(layout, weights, source, limits, out, work, work_size, tasks):  # type: ignore[no-untyped-def]
    """Decode all visible anchors.

    Args:
        layout: `Layout`.
        weights: `Weights`.
        source: `Anchors`.
        limits: Least distance that has a direction, least square of such a quaternion.
        out: `Outputs`, written.
        work: `Work` of the first task, finite numbers.
        work_size: Numbers in it.
        tasks: Into how many tasks to divide the work; does not change the result.
    """
    for task in prange(tasks):
        own = task_work(work, task, work_size)
        for begin in range(task * CHUNK, source.num_visible, tasks * CHUNK):
            end = min(begin + CHUNK, source.num_visible)
            _decode_chunk(layout, weights, source, begin, end, limits, own, out)
