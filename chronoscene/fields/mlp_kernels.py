"""Kernels of small networks: blocks of rows through all layers.

Rows are in groups, a ray with its samples each. Input that all rows of a group share goes through
its part of the first layer once. A chunk is some groups that follow each other; it has gradients of
the weights of its own, which are summed in the order of the chunks. The backward pass computes
hidden layers again, block by block: that takes less time than to write and read them all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy import empty, empty_like, float32
from numpy.typing import NDArray

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.layers import add_column_sums, keep_active
from chronoscene.kernels.matmul import product, relu_product
from chronoscene.kernels.memory import load, load_first, set_zero, store, store_first
from chronoscene.kernels.vector_math import sigmoid
from chronoscene.kernels.vectors import LANES, absolute, any_lane, select, splat

BLOCK = 64  # Rows that go through all layers together
SLICE = 1024  # Gradients of weights summed over the chunks by one task
ZERO = float32(0)
ONE = float32(1)


class Layers(NamedTuple):
    """Sizes of a network, and where its weights lie in one flat array; int64 arrays.

    Layer l has a matrix of `widths` [l, l + 1] at `matrix`, its transpose at `transposed`, and a
    bias. The shared part of the first layer is the last of the matrices.
    """

    widths: NDArray[np.int64]
    """Padded widths: of the input, of each hidden layer, of the output. [K + 1]"""
    matrix: NDArray[np.int64]
    """[K + 1]"""
    transposed: NDArray[np.int64]
    """[K + 1]"""
    bias: NDArray[np.int64]
    """[K]"""
    hidden: NDArray[np.int64]
    """Place of each hidden layer among those of a row. [K]"""
    inputs: int
    outputs: int
    shared: int
    """Numbers that a group shares."""
    shared_pad: int
    row: int
    """Numbers of a row in all hidden layers."""
    size: int
    """Numbers of all weights without the transposes: they come last."""
    sigmoid: bool
    """True if the output goes through the logistic function."""


@inner
def _copy_rows(source, row, width, target, padded, count):  # type: ignore[no-untyped-def]
    """Copy rows into a block and fill it up with zeros."""
    for i in range(count):
        for c in range(0, padded, LANES):
            store(target, i * padded + c, load_first(source, (row + i) * width + c, width - c))
    set_zero(target, count * padded, BLOCK * padded)


@inner
def _shared_part(layers, weights, shared, first, last, work, out):  # type: ignore[no-untyped-def]
    """Send what groups share through the first layer, with its bias. [groups, H]"""
    hidden, pad = layers.widths[1], layers.shared_pad
    zero = (weights, layers.bias[0], 0)
    for group in range(first, last, BLOCK):
        count = min(BLOCK, last - group)
        _copy_rows(shared, group, layers.shared, work, pad, count)
        right = (weights, layers.matrix[-1], hidden)
        into = (out, (group - first) * hidden, hidden)
        product((work, 0, pad, 1), right, zero, into, BLOCK, hidden, layers.shared)


@inner
def _layer(layers, weights, layer, left, into, common, groups, row, count):  # type: ignore[no-untyped-def]
    """Send a block of rows through a layer; ``common`` is the shared part, from its first group."""
    inputs, outputs = layers.widths[layer], layers.widths[layer + 1]
    matrix, bias = (weights, layers.matrix[layer], outputs), (weights, layers.bias[layer], 0)
    if layer == 0:
        for i in range(BLOCK):
            place = (groups[row + min(i, count - 1)] - common[1]) * outputs
            for c in range(0, outputs, LANES):
                store(into[0], into[1] + i * outputs + c, load(common[0], place + c))
        bias = into
    if layer == len(layers.widths) - 2:
        product(left, matrix, bias, into, BLOCK, outputs, inputs)
    else:
        relu_product(left, matrix, bias, into, BLOCK, outputs, inputs)


@inner
def _hidden_layers(layers, weights, x, common, groups, row, count, block, hidden):  # type: ignore[no-untyped-def]
    """Copy a block of rows to ``block`` and compute its hidden layers, one after the other."""
    _copy_rows(x, row, layers.inputs, block, layers.widths[0], count)
    left = (block, 0, layers.widths[0], 1)
    for layer in range(len(layers.widths) - 2):
        width = layers.widths[layer + 1]
        into = (hidden, BLOCK * layers.hidden[layer], width)
        _layer(layers, weights, layer, left, into, common, groups, row, count)
        left = (into[0], into[1], width, 1)
    return left


@kernel(parallel=True)
def mlp_forward(layers, weights, x, shared, starts, groups, chunks, out):  # type: ignore[no-untyped-def]
    """Compute the outputs of all rows.

    Args:
        layers: `Layers`.
        weights: Flat.
        x: Flat [N, I].
        shared: Flat [R, J].
        starts: First row of each group, and the end. int64 [R + 1]
        groups: Group of each row. int32 [N]
        chunks: First group of each chunk, and the end. int64 [C + 1]
        out: Flat [N, O], written.
    """
    depth = len(layers.widths) - 1
    width = layers.widths[depth]
    for chunk in prange(len(chunks) - 1):
        first, last = chunks[chunk], chunks[chunk + 1]
        common = empty((last - first + BLOCK) * layers.widths[1], float32)
        work = empty(BLOCK * max(layers.shared_pad, layers.widths[0]), float32)
        hidden, outputs = empty(BLOCK * layers.row, float32), empty(BLOCK * width, float32)
        _shared_part(layers, weights, shared, first, last, work, common)
        for row in range(starts[first], starts[last], BLOCK):
            count = min(BLOCK, starts[last] - row)
            about = (common, first)
            left = _hidden_layers(layers, weights, x, about, groups, row, count, work, hidden)
            into = (outputs, 0, width)
            _layer(layers, weights, depth - 1, left, into, about, groups, row, count)
            for i in range(count):
                for c in range(0, width, LANES):
                    value = load(outputs, i * width + c)
                    if layers.sigmoid:
                        value = sigmoid(value)
                    store_first(out, (row + i) * layers.outputs + c, value, layers.outputs - c)


@inner
def _output_gradient(layers, out, grads, row, count, target):  # type: ignore[no-untyped-def]
    """Gradient before the last activation; True if any number is not zero."""
    width = layers.widths[-1]
    _copy_rows(grads, row, layers.outputs, target, width, count)
    total = splat(ZERO)
    for i in range(0, count * width, LANES):
        total = total + absolute(load(target, i))
    if layers.sigmoid:
        for i in range(count):
            for c in range(0, width, LANES):
                at, left = (row + i) * layers.outputs + c, layers.outputs - c
                value = load_first(out, at, left)
                grad = load(target, i * width + c)
                store(target, i * width + c, grad * value * (ONE - value))
    return any_lane(select(total <= ZERO, splat(ZERO), splat(ONE)) > ZERO)  # nan is not zero


@inner
def _shared_gradient(layers, weights, shared, first, last, work, common, part, d_shared):  # type: ignore[no-untyped-def]
    """Gradients of what groups share, of its part of the first layer, and of the bias."""
    hidden, pad = layers.widths[1], layers.shared_pad
    other = empty(BLOCK * pad, float32)
    for group in range(first, last, BLOCK):
        count = min(BLOCK, last - group)
        at = (group - first) * hidden
        for i in range(count, BLOCK):
            set_zero(common, at + i * hidden, at + (i + 1) * hidden)
        add_column_sums(common, at, BLOCK, hidden, part, layers.bias[0])
        if pad == 0:
            continue
        _copy_rows(shared, group, layers.shared, work, pad, count)
        into = (part, layers.matrix[-1], hidden)
        product((work, 0, 1, pad), (common, at, hidden), into, into, pad, hidden, BLOCK)
        back = (weights, layers.transposed[-1], pad)
        set_zero(other, 0, BLOCK * pad)
        rows = (other, 0, pad)
        product((common, at, hidden, 1), back, rows, rows, BLOCK, pad, hidden)
        for i in range(count):
            for c in range(0, pad, LANES):
                place = (group + i) * layers.shared + c
                store_first(d_shared, place, load(other, i * pad + c), layers.shared - c)


@kernel(parallel=True)
def mlp_backward(  # type: ignore[no-untyped-def]
    layers, weights, x, shared, starts, groups, chunks, out, grads, partial, d_x, d_shared
):
    """Write gradients of what `mlp_forward` reads; arguments as there, and these.

    Args:
        grads: Of ``out``. Flat [N, O]
        partial: Gradients of the weights, zeros; the first row receives the sum. [C, size]
        d_x: Flat [N, I], zeros.
        d_shared: Flat [R, J], written.
    """
    depth = len(layers.widths) - 1
    widest = layers.widths.max()
    for chunk in prange(len(chunks) - 1):
        first, last, part = chunks[chunk], chunks[chunk + 1], partial[chunk]
        hidden = layers.widths[1]
        common = empty((last - first + BLOCK) * hidden, float32)
        set_zero(common, 0, (last - first) * hidden)
        work = empty(BLOCK * max(layers.shared_pad, widest), float32)
        current, other = empty(BLOCK * widest, float32), empty(BLOCK * widest, float32)
        zeros = empty(widest, float32)
        set_zero(zeros, 0, widest)
        entering, acts = empty_like(common), empty(BLOCK * layers.row, float32)
        _shared_part(layers, weights, shared, first, last, work, entering)
        for row in range(starts[first], starts[last], BLOCK):
            count = min(BLOCK, starts[last] - row)
            d, before = current, other
            if not _output_gradient(layers, out, grads, row, count, d):
                continue
            about = (entering, first)
            _hidden_layers(layers, weights, x, about, groups, row, count, work, acts)
            for layer in range(depth - 1, -1, -1):
                inputs, outputs = layers.widths[layer], layers.widths[layer + 1]
                left = (work, 0)
                if layer:
                    left = (acts, BLOCK * layers.hidden[layer - 1])
                turned = (left[0], left[1], 1, inputs)
                into = (part, layers.matrix[layer], outputs)
                product(turned, (d, 0, outputs), into, into, inputs, outputs, BLOCK)
                if layer:
                    add_column_sums(d, 0, BLOCK, outputs, part, layers.bias[layer])
                else:
                    for i in range(count):
                        place = (groups[row + i] - first) * hidden
                        for c in range(0, hidden, LANES):
                            total = load(common, place + c) + load(d, i * hidden + c)
                            store(common, place + c, total)
                back = (weights, layers.transposed[layer], inputs)
                nothing, rows = (zeros, 0, 0), (before, 0, inputs)
                product((d, 0, outputs, 1), back, nothing, rows, BLOCK, inputs, outputs)
                if layer:
                    keep_active(left[0], left[1], before, BLOCK * inputs)
                d, before = before, d
            width = layers.widths[0]
            for i in range(count):
                for c in range(0, width, LANES):
                    left = layers.inputs - c
                    store_first(d_x, (row + i) * layers.inputs + c, load(d, i * width + c), left)
        _shared_gradient(layers, weights, shared, first, last, work, common, part, d_shared)
    size = partial.shape[1]
    for piece in prange((size + SLICE - 1) // SLICE):
        for i in range(piece * SLICE, min((piece + 1) * SLICE, size)):
            total = partial[0, i]
            for chunk in range(1, len(chunks) - 1):
                total += partial[chunk, i]
            partial[0, i] = total
