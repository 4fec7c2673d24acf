"""Small matrix products inside compiled kernels, at a good part of the processor's peak.

A matrix is ``(memory, start, row)``, memory as in `memory`, with the distance between rows; a left
factor is ``(memory, start, row, step)`` with the distance between columns too, so that it can be
read transposed. Lengths are padded to `PADDING`, so there are no remainders.

Numbers are float32, or pairs of whole numbers of 16 bits, or fours of 8 bits, whose products are
summed in 32 bits.
"""

from __future__ import annotations

from typing import Any

from numba import types
from numba.core import cgutils

from chronoscene.kernels.compilation import inner
from chronoscene.kernels.memory import emit_address, emit_load, emit_store
from chronoscene.kernels.vectors import (
    FLOAT,
    LANES,
    MANY_REGISTERS,
    emit_add_byte_products,
    emit_add_pair_products,
    emit_lanes,
    emit_multiply_add,
    emit_splat,
    emitted,
)

ROW_TILE = 8 if MANY_REGISTERS else 4
"""Rows of the result held in registers, by one or two vectors of columns."""
PADDING = max(ROW_TILE, LANES)


def padded(count: int) -> int:
    """Round a length up to a multiple of `PADDING`."""
    return -(-count // PADDING) * PADDING


class _Matrix:
    """Addresses in a matrix while code is generated."""

    def __init__(self, context: Any, builder: Any, kind: Any, value: Any) -> None:
        self.context, self.builder, self.kind = context, builder, kind[0]
        self.memory, self.start, *self.strides = cgutils.unpack_tuple(builder, value, len(kind))

    def at(self, row: Any, column: Any) -> Any:
        b = self.builder
        across = b.mul(column, self.strides[1]) if len(self.strides) > 1 else column
        index = b.add(b.add(self.start, b.mul(row, self.strides[0])), across)
        return emit_address(self.context, b, self.kind, self.memory, index)


def _make_tile(vectors: int, multiply_add: Any, relu: bool) -> Any:
    """Make the inner loop of `product` for ROW_TILE rows and some vectors of columns."""

    @emitted(
        lambda left, right, first, out, row, column, depth: types.void(
            left, right, first, out, types.intp, types.intp, types.intp
        )
    )
    def tile(context: Any, builder: Any, signature: Any, args: Any) -> None:
        a, b, first, c = (
            _Matrix(context, builder, kind, value)
            for kind, value in zip(signature.args[:4], args[:4], strict=True)
        )
        top, left_column, depth = args[4:]
        index = top.type
        rows = [builder.add(top, index(i)) for i in range(ROW_TILE)]
        columns = [builder.add(left_column, index(i * LANES)) for i in range(vectors)]
        # LLVM turns these variables into registers.
        sums = [
            [
                cgutils.alloca_once_value(builder, emit_load(builder, first.at(m, n)))
                for n in columns
            ]
            for m in rows
        ]
        with cgutils.for_range(builder, depth) as loop:
            vectors_b = [emit_load(builder, b.at(loop.index, n)) for n in columns]
            for m, row_sums in zip(rows, sums, strict=True):
                factor = emit_splat(builder, builder.load(a.at(m, loop.index)), LANES)
                for total, vector in zip(row_sums, vectors_b, strict=True):
                    new = multiply_add(builder, factor, vector, builder.load(total))
                    builder.store(new, total)
        zero = emit_lanes([0.0] * LANES, FLOAT)
        for m, row_sums in zip(rows, sums, strict=True):
            for total, n in zip(row_sums, columns, strict=True):
                value = builder.load(total)
                if relu:
                    # Not a maximum: that would turn what is not a number into 0.
                    negative = builder.fcmp_ordered("<", value, zero)
                    value = builder.select(negative, zero, value)
                emit_store(builder, value, c.at(m, n))

    return tile


def _make_product(multiply_add: Any = emit_multiply_add, relu: bool = False) -> Any:
    one, two = (_make_tile(vectors, multiply_add, relu) for vectors in (1, 2))

    @inner
    def product(left, right, first, out, rows, columns, depth):  # type: ignore[no-untyped-def]
        for column in range(0, columns - LANES, 2 * LANES):
            for row in range(0, rows, ROW_TILE):
                two(left, right, first, out, row, column, depth)
        if columns % (2 * LANES):
            for row in range(0, rows, ROW_TILE):
                one(left, right, first, out, row, columns - LANES, depth)

    return product


product = _make_product()
"""out = first + left @ right.

Args:
    left: [rows, depth], with a step.
    right: [depth, columns]
    first: [rows, columns]; may be ``out``, or one row if its row distance is 0.
    out: [rows, columns]
    rows: Multiple of ROW_TILE.
    columns: Multiple of LANES.
    depth: Any.
"""
relu_product = _make_product(relu=True)
"""out = max(0, first + left @ right); nan stays nan."""
pair_product = _make_product(emit_add_pair_products)
"""Matrix product of int32 matrices, each number a pair of int16: sums of the products of both."""
byte_product = _make_product(emit_add_byte_products)
"""Matrix product as of pairs, of numbers of four bytes each, of the left without and of the right
with a sign; only where there are `BYTE_PRODUCTS`."""
