"""Gradients of the anchor decode, compiled."""

from __future__ import annotations

from typing import NamedTuple

from numba import njit, prange
from numpy import float32

from chronoscene.training._decode_forward import (
    fill_cycles,
    gather_inputs,
    head_columns,
    hidden_layer,
    task_work,
)
from chronoscene.training._decode_layout import BLOCK, CHUNK, CYCLE, Gradients
from chronoscene.training._matmul import product
from chronoscene.training._simd import (
    LANES,
    load,
    load_first,
    read,
    read_index,
    select_less,
    splat,
    store,
    store_first,
    write,
    write_index,
)
from chronoscene.training._vector_math import any_bit, is_zero, quad_spread, quad_sum

SLICE = 1024
"""Gradients of weights summed over the chunks by one task."""
ZERO = float32(0)
ONE = float32(1)


class OutputGradients(NamedTuple):
    """Addresses of the gradients of the loss with respect to the outputs."""

    means: int
    quats: int
    scales: int
    opacities: int
    colors: int


class AnchorGradients(NamedTuple):
    """Addresses of those with respect to what belongs to anchors, zeros at first."""

    offsets: int
    features: int
    log_scales: int


@njit(nogil=True, error_model="numpy")
def _all_zero(values, start, count):  # type: ignore[no-untyped-def]
    bits = splat(ZERO)
    for c in range(0, count, LANES):
        bits = any_bit(bits, load_first(values, start + c, count - c))
    return is_zero(bits)


@njit(nogil=True, error_model="numpy")
def _is_idle(grads, first, count):  # type: ignore[no-untyped-def]
    """Whether no Gaussian of an anchor has a gradient: its offsets may all be switched off."""
    return (
        _all_zero(grads.opacities, first, count)
        and _all_zero(grads.colors, 3 * first, 3 * count)
        and _all_zero(grads.scales, 3 * first, 3 * count)
        and _all_zero(grads.means, 3 * first, 3 * count)
        and _all_zero(grads.quats, 4 * first, 4 * count)
    )


@njit(nogil=True, error_model="numpy")
def _raw_quats(outputs, grads, first, count, raw, at):  # type: ignore[no-untyped-def]
    """d q = (g - (g . unit) unit) / |q|."""
    for c in range(0, 4 * count, LANES):
        unit = load_first(outputs.quats, 4 * first + c, 4 * count - c)
        grad = load_first(grads.quats, 4 * first + c, 4 * count - c)
        inverse = load_first(outputs.inverse_norms, first + c // 4, count - c // 4)
        along = quad_sum(unit * grad)
        store(raw, at + c, (grad - along * unit) * quad_spread(inverse))


@njit(nogil=True, error_model="numpy")
def _sum_cycles(cycles, at, out, start):  # type: ignore[no-untyped-def]
    """Add up every third of CYCLE numbers."""
    a = b = c = ZERO
    for i in range(at, at + CYCLE, 3):
        a += read(cycles, i)
        b += read(cycles, i + 1)
        c += read(cycles, i + 2)
    write(out, start, a)
    write(out, start + 1, b)
    write(out, start + 2, c)


@njit(nogil=True, error_model="numpy")
def _raw_row(layout, source, outputs, grads, anchor, first, work, at, out):  # type: ignore[no-untyped-def]
    """Gradients of the raw outputs of an anchor, and of its offsets and log scales."""
    count, raw, cycles = layout.offsets, work.raw, work.cycles
    fill_cycles(source, anchor, cycles)
    for c in range(0, count, LANES):
        opacity = load_first(outputs.opacities, first + c, count - c)
        grad = load_first(grads.opacities, first + c, count - c)
        store(raw, at + c, grad * (ONE - opacity) * (ONE + opacity))
    _raw_quats(outputs, grads, first, count, raw, at + layout.quats_at)
    sums = 3 * CYCLE
    for c in range(0, 2 * CYCLE, LANES):
        store(cycles, sums + c, splat(ZERO))
    for c in range(0, 3 * count, LANES):
        phase, left, here = c % CYCLE, 3 * count - c, 3 * first + c
        color = load_first(outputs.colors, here, left)
        grad = load_first(grads.colors, here, left)
        store(raw, at + layout.colors_at + c, grad * color * (ONE - color))
        scale = load_first(outputs.scales, here, left)
        grad = load_first(grads.scales, here, left) * scale
        share = scale / load(cycles, CYCLE + phase)
        store(raw, at + layout.scales_at + c, grad * (ONE - share))
        at_scale = sums + CYCLE + phase
        store(cycles, at_scale, load(cycles, at_scale) + grad)
        # The mean is the anchor's plus offset times exp(log_scales[0:3]).
        grad = load_first(grads.means, here, left) * load(cycles, phase)
        offset_at = 3 * count * anchor + c
        store_first(out.offsets, offset_at, grad, left)
        grad = grad * load_first(source.offsets, offset_at, left)
        store(cycles, sums + phase, load(cycles, sums + phase) + grad)
    _sum_cycles(cycles, sums, out.log_scales, 6 * anchor)
    _sum_cycles(cycles, sums + CYCLE, out.log_scales, 6 * anchor + 3)


@njit(nogil=True, error_model="numpy")
def _add_column_sums(values, columns, out):  # type: ignore[no-untyped-def]
    for c in range(0, columns, LANES):
        total = load(out, c)
        for i in range(BLOCK):
            total = total + load(values, i * columns + c)
        store(out, c, total)


@njit(nogil=True, error_model="numpy")
def _output_layer_gradient(layout, weights, work, partial):  # type: ignore[no-untyped-def]
    """From raw outputs to hidden units and to the second layers."""
    pad, hiddens, outputs = layout.hidden_pad, layout.hiddens, layout.outputs_pad
    for head in range(3):
        first, count = head_columns(layout, head)
        hidden = (work.hidden, head * pad, hiddens)
        d_w2 = (partial.w2, first * pad, pad)
        product((work.raw, first, 1, outputs), hidden, d_w2, d_w2, count, pad, BLOCK)
        w2 = (weights.w2, first * pad, pad)
        d_hidden = (work.d_hidden, head * pad, hiddens)
        zeros = (weights.zeros, 0, 0)
        product((work.raw, first, outputs, 1), w2, zeros, d_hidden, BLOCK, pad, count)
    zero = splat(ZERO)
    for i in range(0, BLOCK * hiddens, LANES):
        grad = select_less(zero, load(work.hidden, i), load(work.d_hidden, i), zero)
        store(work.d_hidden, i, grad)
    _add_column_sums(work.raw, outputs, partial.b2)
    _add_column_sums(work.d_hidden, hiddens, partial.b1)


@njit(nogil=True, error_model="numpy")
def _hidden_layer_gradient(layout, weights, work, partial):  # type: ignore[no-untyped-def]
    """From hidden units to features and to the first layers."""
    hiddens, inputs, columns = layout.hiddens, layout.inputs_pad, layout.features_pad
    d_hidden = (work.d_hidden, 0, hiddens)
    d_w1 = (partial.w1_t, 0, hiddens)
    product((work.x, 0, 1, inputs), d_hidden, d_w1, d_w1, inputs, hiddens, BLOCK)
    w1, zeros = (weights.w1, 0, columns), (weights.zeros, 0, 0)
    d_x = (work.d_x, 0, columns)
    product((work.d_hidden, 0, hiddens, 1), w1, zeros, d_x, BLOCK, columns, hiddens)


@njit(nogil=True, error_model="numpy")
def _write_features(layout, source, anchor, d_x, at, out):  # type: ignore[no-untyped-def]
    """Spread the gradient of an input over the base and the periods that were mixed in."""
    row = anchor * layout.row
    for c in range(0, layout.base, LANES):
        grad = load_first(d_x, at + c, layout.base - c)
        store_first(out.features, row + c, grad, layout.base - c)
    for s in range(source.num_periods):
        start = row + layout.base + read_index(source.periods, s) * layout.period
        for c in range(0, layout.period, LANES):
            left = layout.period - c
            grad = read(source.weights, s) * load_first(d_x, at + layout.base + c, left)
            store_first(out.features, start + c, grad, left)


@njit(nogil=True, error_model="numpy")
def _block_gradient(layout, weights, source, count, work, partial, out):  # type: ignore[no-untyped-def]
    """Everything behind the raw outputs of the anchors in the first rows of the work space."""
    for i in range(count * layout.outputs_pad, BLOCK * layout.outputs_pad, LANES):
        store(work.raw, i, splat(ZERO))
    hidden_layer(layout, weights, work)
    _output_layer_gradient(layout, weights, work, partial)
    _hidden_layer_gradient(layout, weights, work, partial)
    for i in range(count):
        anchor = read_index(work.rows, i)
        _write_features(layout, source, anchor, work.d_x, i * layout.features_pad, out)


@njit(nogil=True, error_model="numpy")
def _chunk_gradient(  # type: ignore[no-untyped-def]
    layout, weights, source, outputs, grads, begin, end, minimum, work, partial, out
):
    """Anchors begin..end, those with a gradient gathered into blocks."""
    count = 0
    for m in range(begin, end):
        first = m * layout.offsets
        if not _is_idle(grads, first, layout.offsets):
            anchor = read_index(source.visible, m)
            write_index(work.rows, count, anchor)
            at = count * layout.outputs_pad
            _raw_row(layout, source, outputs, grads, anchor, first, work, at, out)
            gather_inputs(layout, source, anchor, minimum, work.x, count * layout.inputs_pad)
            count += 1
        if count == BLOCK or (m == end - 1 and count):
            _block_gradient(layout, weights, source, count, work, partial, out)
            count = 0


@njit(nogil=True, error_model="numpy")
def _chunk_partial(partial, chunk, size):  # type: ignore[no-untyped-def]
    """Gradients of the weights in a chunk, set to zero."""
    move = 4 * chunk * size
    for i in range(size):
        write(partial.w1_t + move, i, ZERO)
    return Gradients(partial.w1_t + move, partial.b1 + move, partial.w2 + move, partial.b2 + move)


@njit(cache=True, nogil=True, parallel=True, error_model="numpy")
def decode_backward(  # type: ignore[no-untyped-def]
    layout, weights, source, limits, outputs, grads, out, partial, size, work, work_size, tasks
):
    """Gradients of what `decode_forward` reads.

    Args:
        layout: As forward, like ``weights``, ``source``, ``limits``, ``work`` and ``work_size``.
        outputs: `Outputs` of the forward pass.
        grads: `OutputGradients`.
        out: `AnchorGradients`, written in rows of anchors that have a gradient.
        partial: `Gradients` of the first chunk, in the end of all; those of other chunks follow.
        size: Numbers in it.
        tasks: As forward.
    """
    # One at least: where nothing is visible, it is what sets the gradients to zero.
    chunks = max(1, (source.num_visible + CHUNK - 1) // CHUNK)
    for task in prange(tasks):
        own = task_work(work, task, work_size)
        for chunk in range(task, chunks, tasks):
            begin = chunk * CHUNK
            end = min(begin + CHUNK, source.num_visible)
            part = _chunk_partial(partial, chunk, size)
            _chunk_gradient(
                layout, weights, source, outputs, grads, begin, end, limits[0], own, part, out
            )
    for i in prange((size + SLICE - 1) // SLICE):
        for j in range(i * SLICE, min((i + 1) * SLICE, size), LANES):
            total = load_first(partial.w1_t, j, size - j)
            for chunk in range(1, chunks):
                total = total + load_first(partial.w1_t, chunk * size + j, size - j)
            store_first(partial.w1_t, j, total, size - j)
