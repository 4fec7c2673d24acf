"""Gradients through the second layers of the heads, for the Gaussians that have one.

A matrix product would multiply mostly zeros: of an anchor's Gaussians few are in view. So this goes
offset by offset, over the anchors of a block in which the offset has a gradient: the eleven rows
of weights of an offset and their gradients stay in registers meanwhile.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from chronoscene.kernels.memory import emit_load, emit_store
from chronoscene.kernels.vectors import FLOAT, LANES, emit_multiply_add, emit_splat, intrinsic

PARTS = ((0, 1), (1, 3), (1, 4), (2, 3))
"""Head and number of outputs per offset of opacity, scale, quaternion and colour."""


def _numbers(builder: Any, address: Any) -> Callable[[Any], Any]:
    """Return a pointer to each of the float32 numbers at an address, while code is generated."""
    base = builder.inttoptr(address, FLOAT.as_pointer())
    return lambda index: builder.gep(base, [index])


@intrinsic
def add_offset(
    typing: Any, grads: Any, places: Any, rows: Any, lengths: Any, slots: Any, count: Any, unit: Any
) -> Any:
    """Add what one offset contributes, for LANES hidden units of each head from ``unit`` on.

    With g the gradient of an output, h the hidden units and w its weights, for every slot:
    d_hidden += g w, and then d_w += g h.

    Args:
        grads: Addresses of g for the Gaussians of the block: opacities, scales, quaternions,
            colours.
        places: Addresses of hidden, d_hidden, w and d_w.
        rows: First rows of opacity, scale, quaternion and colour of the offset in w.
        lengths: Of rows of hidden units, of those of one head.
        slots: Address of pairs of row in the block and Gaussian. int64 [count, 2]
        count: How many.
        unit: First hidden unit.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        b = builder
        unpacked = [cgutils.unpack_tuple(b, args[i], n) for i, n in enumerate((4, 4, 4, 2))]
        grads = [_numbers(b, place) for place in unpacked[0]]
        hidden, d_hidden, w, d_w = (_numbers(b, place) for place in unpacked[1])
        hiddens, pad = unpacked[3]
        slots, count, unit = args[4:]
        index = count.type
        outputs = [(part, i) for part, (_, number) in enumerate(PARTS) for i in range(number)]
        cells = [b.add(b.mul(b.add(unpacked[2][part], index(i)), pad), unit) for part, i in outputs]
        weights = [emit_load(b, w(cell)) for cell in cells]
        sums = [cgutils.alloca_once_value(b, emit_load(b, d_w(cell))) for cell in cells]
        slots = b.inttoptr(slots, ir.IntType(64).as_pointer())
        with cgutils.for_range(b, count) as loop:
            pair = b.mul(loop.index, index(2))
            slot = b.load(b.gep(slots, [pair]))
            gaussian = b.load(b.gep(slots, [b.add(pair, index(1))]))
            start = b.add(b.mul(slot, hiddens), unit)
            units = [b.add(start, b.mul(pad, index(head))) for head in range(3)]
            values = [emit_load(b, hidden(at)) for at in units]
            totals = [emit_load(b, d_hidden(at)) for at in units]
            for n, (part, i) in enumerate(outputs):
                head, number = PARTS[part]
                at = b.add(b.mul(gaussian, index(number)), index(i))
                grad = emit_splat(b, b.load(grads[part](at)), LANES)
                totals[head] = emit_multiply_add(b, grad, weights[n], totals[head])
                new = emit_multiply_add(b, grad, values[head], b.load(sums[n]))
                b.store(new, sums[n])
            for at, total in zip(units, totals, strict=True):
                emit_store(b, total, d_hidden(at))
        for cell, total in zip(cells, sums, strict=True):
            emit_store(b, b.load(total), d_w(cell))
        return context.get_dummy_value()

    integers = (types.intp, types.intp, types.intp)
    return types.void(grads, places, rows, lengths, *integers), generate


@intrinsic
def add_biases(typing: Any, grads: Any, d_b: Any, rows: Any, slots: Any, count: Any) -> Any:
    """Add the gradients of the outputs of one offset to those of the biases.

    Args:
        grads: As for `add_offset`, like ``rows``, ``slots`` and ``count``. Four numbers are read
            where an output has fewer.
        d_b: Address of the gradients of the biases.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        b = builder
        grads = [_numbers(b, place) for place in cgutils.unpack_tuple(b, args[0], 4)]
        biases, rows = _numbers(b, args[1]), cgutils.unpack_tuple(b, args[2], 4)
        count = args[4]
        index = count.type
        quad = ir.VectorType(FLOAT, 4)
        sums = [cgutils.alloca_once_value(b, ir.Constant(quad, [0.0] * 4)) for _ in PARTS]
        slots = b.inttoptr(args[3], ir.IntType(64).as_pointer())
        with cgutils.for_range(b, count) as loop:
            pair = b.add(b.mul(loop.index, index(2)), index(1))
            gaussian = b.load(b.gep(slots, [pair]))
            for part, (_, number) in enumerate(PARTS):
                pointer = grads[part](b.mul(gaussian, index(number)))
                value = b.load(b.bitcast(pointer, quad.as_pointer()), typ=quad)
                value.align = 4
                b.store(b.fadd(b.load(sums[part]), value), sums[part])
        for part, (_, number) in enumerate(PARTS):
            total = b.load(sums[part])
            for i in range(number):
                place = biases(b.add(rows[part], index(i)))
                lane = b.extract_element(total, ir.IntType(32)(i))
                b.store(b.fadd(b.load(place), lane), place)
        return context.get_dummy_value()

    return types.void(grads, d_b, rows, types.intp, types.intp), generate
