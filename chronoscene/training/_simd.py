"""Explicit vectors of float32 for compiled kernels.

LLVM does not vectorise loops over few numbers, nor keep a block of a matrix product in registers.
So `Vector` is one machine register (16 lanes with AVX-512, 8 with AVX2, else 4), with arithmetic,
loads and stores that become single instructions, and `tile_product` is the inner loop of a matrix
product. Without a fused multiply-add in hardware the same code multiplies and adds.

None of these check bounds.
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

_FLOAT = ir.FloatType()
_INT = ir.IntType(32)
_FLOATS = ir.VectorType(_FLOAT, LANES)
_INTS = ir.VectorType(_INT, LANES)
_MASK = ir.VectorType(ir.IntType(1), LANES)


class VectorType(types.Type):
    """Numba type of a register full of float32."""

    def __init__(self) -> None:
        super().__init__(name=f"Vector{LANES}")


Vector = VectorType()


@register_model(VectorType)
class _VectorModel(models.PrimitiveModel):
    def __init__(self, dmm: Any, fe_type: Any) -> None:
        super().__init__(dmm, fe_type, _FLOATS)


def _splat(builder: Any, scalar: Any) -> Any:
    single = builder.insert_element(ir.Constant(_FLOATS, ir.Undefined), scalar, _INT(0))
    return builder.shuffle_vector(
        single, ir.Constant(_FLOATS, ir.Undefined), ir.Constant(_INTS, [0] * LANES)
    )


def _constant(value: float) -> Any:
    return ir.Constant(_FLOATS, [float(float32(value))] * LANES)


def _multiply_add(builder: Any, a: Any, b: Any, c: Any) -> Any:
    # fmuladd fuses where the processor can; fma would call a slow library function where not.
    kind = ir.FunctionType(_FLOATS, [_FLOATS] * 3)
    name = f"llvm.fmuladd.v{LANES}f32"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), [a, b, c])


def _address(context: Any, builder: Any, array_type: Any, array: Any, index: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [index])


def _load(builder: Any, address: Any) -> Any:
    pointer = builder.bitcast(address, _FLOATS.as_pointer())
    value = builder.load(pointer, typ=_FLOATS)
    value.align = 4
    return value


def _store(builder: Any, value: Any, address: Any) -> None:
    builder.store(value, builder.bitcast(address, _FLOATS.as_pointer())).align = 4


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
            value if kind == Vector else _splat(builder, value)
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
def load(typing: Any, array: Any, index: Any) -> Any:
    """Read LANES numbers of a flat float32 array from ``index`` on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _load(builder, _address(context, builder, signature.args[0], *args))

    return Vector(array, types.intp), generate


@intrinsic
def store(typing: Any, array: Any, index: Any, value: Any) -> Any:
    """Write LANES numbers into a flat float32 array from ``index`` on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args[:2])
        _store(builder, args[2], address)
        return context.get_dummy_value()

    return types.void(array, types.intp, Vector), generate


@intrinsic
def store_first(typing: Any, array: Any, index: Any, value: Any, count: Any) -> Any:
    """Write the first ``count`` lanes; at most LANES."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = _address(context, builder, signature.args[0], *args[:2])
        count = builder.trunc(args[3], _INT)
        counts = builder.insert_element(ir.Constant(_INTS, ir.Undefined), count, _INT(0))
        counts = builder.shuffle_vector(
            counts, ir.Constant(_INTS, ir.Undefined), ir.Constant(_INTS, [0] * LANES)
        )
        mask = builder.icmp_signed("<", ir.Constant(_INTS, list(range(LANES))), counts)
        pointer = builder.bitcast(address, _FLOATS.as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [_FLOATS, pointer.type, _INT, _MASK])
        name = f"llvm.masked.store.v{LANES}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(function, [args[2], pointer, _INT(4), mask])
        return context.get_dummy_value()

    return types.void(array, types.intp, Vector, types.intp), generate


@intrinsic
def splat(typing: Any, value: Any) -> Any:
    """The same number in all lanes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _splat(builder, args[0])

    return Vector(types.float32), generate


@intrinsic
def multiply_add(typing: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once where the processor can."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _multiply_add(builder, *args)

    return Vector(Vector, Vector, Vector), generate


@intrinsic
def select_less(typing: Any, a: Any, b: Any, yes: Any, no: Any) -> Any:
    """``yes`` in lanes where a < b, else ``no``, also where either is not a number."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.select(builder.fcmp_ordered("<", args[0], args[1]), args[2], args[3])

    return Vector(Vector, Vector, Vector, Vector), generate


@intrinsic
def square_root(typing: Any, value: Any) -> Any:
    """Root of every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        kind = ir.FunctionType(_FLOATS, [_FLOATS])
        name = f"llvm.sqrt.v{LANES}f32"
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

    return Vector(Vector), generate


@intrinsic
def lane_sum(typing: Any, value: Any) -> Any:
    """Sum of all lanes, halves added to halves: the order is fixed."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, half = args[0], LANES // 2
        while half:
            order = [(i + half) % LANES for i in range(LANES)]
            turned = builder.shuffle_vector(total, total, ir.Constant(_INTS, order))
            total = builder.fadd(total, turned)
            half //= 2
        return builder.extract_element(total, _INT(0))

    return types.float32(Vector), generate
