"""A register full of float32 for compiled kernels, and the memory that it is read from.

`Vector` is one machine register (16 lanes with AVX-512, 8 with AVX2, else 4), of the vectors in
`chronoscene.kernels.simd`. `memory` has loads and stores, `vector_math` functions. Without a fused
multiply-add in hardware the same code multiplies and adds.

Functions named ``emit_`` write LLVM code and are for other intrinsics.
"""

from __future__ import annotations

import platform
from functools import partial
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numpy import float32

from chronoscene.kernels import simd
from chronoscene.kernels.simd import intrinsic

LANES = simd.REGISTER_LANES
"""Float32 numbers in a `Vector`."""
MANY_REGISTERS = LANES == 16 or platform.machine() in ("aarch64", "arm64")
"""32 vector registers, else 16."""

Vector = simd.Vector("f32", LANES)
FLOAT = ir.FloatType()
INT = simd.I32
FLOATS = Vector.llvm
INTS = ir.VectorType(INT, LANES)

emit_splat = partial(simd.emit_splat, lanes=LANES)
splat = simd.make_splat("f32", LANES)


def emit_constant(value: float) -> Any:
    return ir.Constant(FLOATS, [float(float32(value))] * LANES)


def emit_multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    # fmuladd fuses where the processor can; fma would call a slow library function where not.
    kind = ir.FunctionType(FLOATS, [FLOATS] * 3)
    name = f"llvm.fmuladd.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [a, b, c])


def emit_address(context: Any, builder: Any, kind: Any, memory: Any, index: Any) -> Any:
    if isinstance(kind, types.Integer):
        return builder.gep(builder.inttoptr(memory, FLOAT.as_pointer()), [index])
    return builder.gep(context.make_array(kind)(context, builder, memory).data, [index])


def emit_load(builder: Any, address: Any) -> Any:
    pointer = builder.bitcast(address, FLOATS.as_pointer())
    value = builder.load(pointer, typ=FLOATS)
    value.align = 4
    return value


def emit_store(builder: Any, value: Any, address: Any) -> None:
    builder.store(value, builder.bitcast(address, FLOATS.as_pointer())).align = 4


@intrinsic
def multiply_add(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once where the processor can."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return emit_multiply_add(builder, *args)

    return Vector(Vector, Vector, Vector), generate


@intrinsic
def select_less(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """``yes`` in lanes where a < b, else ``no``, also where either is not a number."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return Vector(Vector, Vector, Vector, Vector), generate
