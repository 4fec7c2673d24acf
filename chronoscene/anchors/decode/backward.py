"""Gradients of the anchor decode, compiled.

Anchors with a gradient are gathered into blocks. The first layers are matrix products over a block;
for the second layers see `second_layers`.
"""

from __future__ import annotations

from numba import prange
from numpy import float32

from chronoscene.anchors.decode.forward import (
    block_start,
    factors,
    gather_inputs,
    hidden_layer,
    tiled,
)
from chronoscene.anchors.decode.layout import BLOCK, CHUNK, CYCLE
from chronoscene.anchors.decode.second_layers import add_biases, add_offset
from chronoscene.kernels.compilation import inner, kernel
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
    store_cycle,
    store_first,
    write,
    write_index,
)
from chronoscene.kernels.vector_math import quad_spread, quad_sum
from chronoscene.kernels.vectors import LANES, splat

SLICE = 1024  # Gradients of weights summed over the chunks by one task
ZERO = float32(0)
ONE = float32(1)


@inner
def _has_gradient(grads, g):  # type: ignore[no-untyped-def]
    """Return True if a Gaussian has a gradient: it may be out of the image, or hidden."""
    if read(grads.opacities, g) != ZERO:
        return True
    found = False
    for c in range(3 * g, 3 * g + 3):
        found |= read(grads.colors, c) != ZERO
        found |= read(grads.means, c) != ZERO
        found |= read(grads.scales, c) != ZERO
    for c in range(4 * g, 4 * g + 4):
        found |= read(grads.quats, c) != ZERO
    return found


@inner
def _raw_gradients(outputs, grads, g, count, work, done):  # type: ignore[no-untyped-def]
    """Write gradients of the raw outputs of an anchor's Gaussians, behind those ``done`` before:

    tanh' = 1 - tanh^2, sigmoid' = sigmoid (1 - sigmoid), d q/|q| = (I - q q^T / |q|^2) / |q|.
    """
    for c in range(0, count, LANES):
        opacity = load_first(outputs.opacities, g + c, count - c)
        grad = load_first(grads.opacities, g + c, count - c)
        store(work.opacities, done + c, grad * (ONE - opacity) * (ONE + opacity))
    for c in range(0, 4 * count, LANES):
        unit = load_first(outputs.quats, 4 * g + c, 4 * count - c)
        grad = load_first(grads.quats, 4 * g + c, 4 * count - c)
        inverse = load_first(outputs.inverse_norms, g + c // 4, count - c // 4)
        along = quad_sum(unit * grad)
        store(work.quats, 4 * done + c, (grad - along * unit) * quad_spread(inverse))
    for c in range(0, 3 * count, LANES):
        at, left = 3 * g + c, 3 * count - c
        color = load_first(outputs.colors, at, left)
        grad = load_first(grads.colors, at, left)
        store(work.colors, 3 * done + c, grad * color * (ONE - color))
        scale = load_first(outputs.scales, at, left)
        grad = load_first(grads.scales, at, left) * scale
        store(work.factors, 3 * done + c, grad)
        share = scale / load(work.row, CYCLE + c % CYCLE)
        store(work.scales, 3 * done + c, grad * (ONE - share))


@inner
def _offset_gradients(layout, source, outputs, grads, m, g, count, work, done, out):  # type: ignore[no-untyped-def]
    """Write gradients of offsets and log scales: means are anchor + offset exp(log_scales[0:3])."""
    anchor = read_index(source.visible, m)
    for c in range(3):
        offset_sum = scale_sum = ZERO
        for i in range(count):
            j = read_index(outputs.positions, g + i) - m * layout.offsets
            at = 3 * (anchor * layout.offsets + j) + c
            grad = read(grads.means, 3 * (g + i) + c) * read(work.row, c)
            write(out.offsets, at, grad)
            offset_sum += grad * read(source.offsets, at)
            scale_sum += read(work.factors, 3 * (done + i) + c)
        write(out.log_scales, 6 * anchor + c, offset_sum)
        write(out.log_scales, 6 * anchor + 3 + c, scale_sum)


@inner
def _anchor_gradient(layout, source, outputs, grads, m, slot, work, done, out):  # type: ignore[no-untyped-def]
    """Go back to the raw outputs; note the slot with every offset that has a gradient."""
    g, stop = read_index(outputs.starts, m), read_index(outputs.starts, m + 1)
    factors(source, read_index(source.visible, m), work.row)
    store_cycle(work.row, CYCLE, work.row, 3)
    _raw_gradients(outputs, grads, g, stop - g, work, done)
    _offset_gradients(layout, source, outputs, grads, m, g, stop - g, work, done, out)
    for i in range(stop - g):
        if _has_gradient(grads, g + i):
            j = read_index(outputs.positions, g + i) - m * layout.offsets
            count = read_index(work.counts, j)
            write_index(work.slots, 2 * (j * BLOCK + count), slot)
            write_index(work.slots, 2 * (j * BLOCK + count) + 1, done + i)
            write_index(work.counts, j, count + 1)
    return done + stop - g


@inner
def _output_layer_gradient(layout, weights, work, rows, partial):  # type: ignore[no-untyped-def]
    """Go back from the raw outputs to the hidden units and the second layers."""
    for i in range(0, rows * layout.hiddens, LANES):
        store(work.d_hidden, i, splat(ZERO))
    grads = (work.opacities, work.scales, work.quats, work.colors)
    places = (work.hidden, work.d_hidden, weights.w2, partial.w2)
    lengths = (layout.hiddens, layout.hidden_pad)
    for j in range(layout.offsets):
        scale, quat = layout.scales_at + 3 * j, layout.quats_at + 4 * j
        color = layout.colors_at + 3 * j
        slots, count = work.slots + 16 * j * BLOCK, read_index(work.counts, j)
        for unit in range(0, layout.hidden_pad, LANES):
            add_offset(grads, places, (j, scale, quat, color), lengths, slots, count, unit)
        add_biases(grads, partial.b2, (j, scale, quat, color), slots, count)
        write_index(work.counts, j, 0)


@inner
def _hidden_layer_gradient(layout, weights, work, count, partial):  # type: ignore[no-untyped-def]
    """Go back from hidden units to features and to the first layers."""
    hiddens, inputs, columns = layout.hiddens, layout.inputs_pad, layout.features_pad
    rows = tiled(count)
    keep_active(work.hidden, 0, work.d_hidden, count * hiddens)
    for i in range(count * hiddens, rows * hiddens, LANES):
        store(work.d_hidden, i, splat(ZERO))
    add_column_sums(work.d_hidden, 0, count, hiddens, partial.b1, 0)
    d_hidden = (work.d_hidden, 0, hiddens)
    d_w1 = (partial.w1_t, 0, hiddens)
    product((work.x, 0, 1, inputs), d_hidden, d_w1, d_w1, tiled(layout.inputs), hiddens, count)
    w1, zeros = (weights.w1, 0, columns), (weights.zeros, 0, 0)
    d_x = (work.d_x, 0, columns)
    product((work.d_hidden, 0, hiddens, 1), w1, zeros, d_x, rows, columns, hiddens)


@inner
def _write_features(layout, source, anchor, d_x, at, out):  # type: ignore[no-untyped-def]
    """Spread the gradient of an input over the base and the periods that were mixed in."""
    row = anchor * layout.base
    for c in range(0, layout.base, LANES):
        grad = load_first(d_x, at + c, layout.base - c)
        store_first(out.features, row + c, grad, layout.base - c)
    for s in range(source.num_periods):
        start = block_start(layout, source, anchor, s)
        for c in range(0, layout.period, LANES):
            left = layout.period - c
            grad = read(source.weights, s) * load_first(d_x, at + layout.base + c, left)
            # Periods may share a block.
            grad = load_first(out.blocks, start + c, left) + grad
            store_first(out.blocks, start + c, grad, left)


@inner
def _block_gradient(layout, weights, source, outputs, grads, count, work, partial, out):  # type: ignore[no-untyped-def]
    """Add gradients of the visible anchors in the first rows of the work space."""
    hidden_layer(layout, weights, work, count, 0, layout.hiddens)
    done = 0
    for i in range(count):
        m = read_index(work.rows, i)
        done = _anchor_gradient(layout, source, outputs, grads, m, i, work, done, out)
    _output_layer_gradient(layout, weights, work, count, partial)
    _hidden_layer_gradient(layout, weights, work, count, partial)
    for i in range(count):
        anchor = read_index(source.visible, read_index(work.rows, i))
        _write_features(layout, source, anchor, work.d_x, i * layout.features_pad, out)


@inner
def _clear_rows(layout, source, begin, end, out):  # type: ignore[no-untyped-def]
    """Set to zero the rows of visible anchors begin..end, and those between them and the last
    visible one before: soon enough before they are written that they are still in the cache."""
    first = read_index(source.visible, begin - 1) + 1 if begin else 0
    last = source.num_anchors
    if end < source.num_visible:
        last = read_index(source.visible, end - 1) + 1
    set_zero(out.offsets, 3 * layout.offsets * first, 3 * layout.offsets * last)
    set_zero(out.features, layout.base * first, layout.base * last)
    set_zero(out.log_scales, 6 * first, 6 * last)


@inner
def _chunk_gradient(layout, weights, source, outputs, grads, begin, end, work, partial, out):  # type: ignore[no-untyped-def]
    """Add gradients of visible anchors begin..end, gathered into blocks."""
    _clear_rows(layout, source, begin, end, out)
    count = 0
    for m in range(begin, end):
        g, stop = read_index(outputs.starts, m), read_index(outputs.starts, m + 1)
        while g < stop and not _has_gradient(grads, g):
            g += 1
        if g < stop:
            write_index(work.rows, count, m)
            gather_inputs(layout, source, m, work.x, count)
            count += 1
        if count == BLOCK or (m == end - 1 and count):
            _block_gradient(layout, weights, source, outputs, grads, count, work, partial, out)
            count = 0


@kernel(parallel=True)
def decode_backward(  # type: ignore[no-untyped-def]
    layout, weights, source, outputs, grads, out, partial, size, work, work_size, tasks
):
    """Write gradients of what `decode_forward` reads; arguments as there, and these.

    Args:
        grads: `OutputGradients`.
        out: `AnchorGradients`, written.
        partial: `Gradients` of the first chunk, in the end of all; those of other chunks follow.
        size: Numbers in it.
    """
    # One at least: where nothing is visible, it sets the gradients to zero.
    chunks = max(1, (source.num_visible + CHUNK - 1) // CHUNK)
    for task in prange(tasks):
        own = moved(work, task * work_size)
        for chunk in range(task, chunks, tasks):
            begin = chunk * CHUNK
            end = min(begin + CHUNK, source.num_visible)
            part = moved(partial, chunk * size)
            set_zero(part.w1_t, 0, size)
            _chunk_gradient(layout, weights, source, outputs, grads, begin, end, own, part, out)
    for i in prange((size + SLICE - 1) // SLICE):
        sum_parts(partial.w1_t, chunks, size, i * SLICE, min((i + 1) * SLICE, size))
