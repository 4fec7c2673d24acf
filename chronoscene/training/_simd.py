"""Explicit vectors of float32 for compiled kernels.

LLVM does not vectorise loops over few numbers, nor keep a block of a matrix product in registers.
So `Vector` is one machine register (16 lanes with AVX-512, 8 with AVX2, else 4), with arithmetic
that becomes single instructions. `_memory` has loads and stores, `_vector_math` functions. Without
a fused multiply-add in hardware the same code multiplies and adds.

Functions named ``emit_`` write LLVM code and are for other intrinsics.
"""

from __future__ import annotations

import operator
import platform
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba.extending
from llvmlite import ir
from numba import config, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable
from numpy import float32

# The declared type of an intrinsic has the typing context as an argument that callers leave out.
intrinsic: Any = numba.extending.intrinsic

FLAGS = ("contract", "nsz", "arcp")


def _host_features() -> str:
    if config.CPU_FEATURES is not None:  # type: ignore[attr-defined]
        return str(config.CPU_FEATURES)  # type: ignore[attr-defined]
    return str(llvmlite.binding.get_host_cpu_features().flatten())


def _lanes(features: str) -> int:
    names = features.split(",")
    if "+avx512f" in names:
        return 16
    return 8 if "+avx2" in names else 4


LANES = _lanes(_host_features())
"""Float32 numbers in a `Vector`."""
MANY_REGISTERS = LANES == 16 or platform.machine() in ("aarch64", "arm64")
"""32 vector registers, else 16."""

FLOAT = ir.FloatType()
INT = ir.IntType(32)
FLOATS = ir.VectorType(FLOAT, LANES)
INTS = ir.VectorType(INT, LANES)


class VectorType(types.Type):
    """Numba type of a register full of float32."""

    def __init__(self) -> None:
        super().__init__(name=f"Vector{LANES}")


Vector = VectorType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, FLOATS)


def emit_splat(builder: Any, scalar: Any) -> Any:
    single = builder.insert_element(ir.Constant(FLOATS, ir.Undefined), scalar, INT(0))
    return builder.shuffle_vector(
        single, ir.Constant(FLOATS, ir.Undefined), ir.Constant(INTS, [0] * LANES)
    )


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


def _define_operator(symbol: Callable[..., Any], instruction: str) -> None:
    """Teach Numba an operator between vectors, or a vector and a float32."""

    @type_callable(symbol)
    def typer(context: Any) -> Any:
        def typing(a: Any, b: Any) -> Any:
            if {a, b} <= {Vector, types.float32} and Vector in (a, b):
                return Vector
            return None

        return typing

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, b = (
            value if kind == Vector else emit_splat(builder, value)
            for value, kind in zip(args, signature.args, strict=True)
        )
        return getattr(builder, instruction)(a, b, flags=FLAGS)

    for pair in ((Vector, Vector), (Vector, types.float32), (types.float32, Vector)):
        lower_builtin(symbol, *pair)(generate)


_define_operator(operator.add, "fadd")
_define_operator(operator.sub, "fsub")
_define_operator(operator.mul, "fmul")
_define_operator(operator.truediv, "fdiv")


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """The same number in all lanes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return emit_splat(builder, args[0])

    return Vector(types.float32), generate


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
