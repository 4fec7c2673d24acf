"""Explicit vectors of float32 for compiled kernels.

LLVM does not vectorise loops over few numbers, nor keep a block of a matrix product in registers.
So `Vector` is one machine register (16 lanes with AVX-512, 8 with AVX2, else 4), with arithmetic,
loads and stores that become single instructions, and `tile_product` is the inner loop of a matrix
product. Without a fused multiply-add in hardware the same code multiplies and adds.

Memory is a flat float32 array or, as an integer, an address. Loops over rows want addresses: Numba
counts the references to an array whenever it is passed on, and threads that do so with the same
array wait for each other. The caller keeps the memory alive.

None of these check bounds. Functions named ``emit_`` write LLVM code and are for other intrinsics.
"""

from __future__ import annotations

import operator
import platform
from collections.abc import Callable
from typing import Any

import llvmlite.binding
import numba.extending
from llvmlite import ir
from numba import config, njit, types
from numba.core import cgutils
from numba.extending import lower_builtin, models, register_model, type_callable
from numpy import float32

# The declared type of an intrinsic has the typing context as an argument that callers leave out.
intrinsic: Any = numba.extending.intrinsic

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cpython_wrapper": True,
    "no_cfunc_wrapper": True,
}
inner: Any = njit(**_OPTIONS)
"""Decorator of functions that only compiled code calls: without ways in from elsewhere they compile
faster."""

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
def load(typing: Any, memory: Any, index: Any) -> Any:
    """Read LANES numbers from ``index`` on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return emit_load(builder, emit_address(context, builder, signature.args[0], *args))

    return Vector(memory, types.intp), generate


@intrinsic
def store(typing: Any, memory: Any, index: Any, value: Any) -> Any:
    """Write LANES numbers from ``index`` on."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = emit_address(context, builder, signature.args[0], *args[:2])
        emit_store(builder, args[2], address)
        return context.get_dummy_value()

    return types.void(memory, types.intp, Vector), generate


def emit_first_lanes(builder: Any, count: Any) -> Any:
    """Mask of the lanes below ``count``, any integer."""
    wide = count.type
    clipped = builder.select(builder.icmp_signed("<", count, wide(LANES)), count, wide(LANES))
    single = builder.insert_element(
        ir.Constant(INTS, ir.Undefined), builder.trunc(clipped, INT), INT(0)
    )
    counts = builder.shuffle_vector(
        single, ir.Constant(INTS, ir.Undefined), ir.Constant(INTS, [0] * LANES)
    )
    return builder.icmp_signed("<", ir.Constant(INTS, list(range(LANES))), counts)


@intrinsic
def load_first(typing: Any, memory: Any, index: Any, count: Any) -> Any:
    """Read the first ``count`` lanes, and nothing beyond; the others are 0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = emit_address(context, builder, signature.args[0], *args[:2])
        pointer = builder.bitcast(address, FLOATS.as_pointer())
        mask = emit_first_lanes(builder, args[2])
        kind = ir.FunctionType(FLOATS, [pointer.type, INT, mask.type, FLOATS])
        name = f"llvm.masked.load.v{LANES}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        return builder.call(function, [pointer, INT(4), mask, emit_constant(0.0)])

    return Vector(memory, types.intp, types.intp), generate


@intrinsic
def store_first(typing: Any, memory: Any, index: Any, value: Any, count: Any) -> Any:
    """Write the first ``count`` lanes and nothing beyond."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        address = emit_address(context, builder, signature.args[0], *args[:2])
        pointer = builder.bitcast(address, FLOATS.as_pointer())
        mask = emit_first_lanes(builder, args[3])
        kind = ir.FunctionType(ir.VoidType(), [FLOATS, pointer.type, INT, mask.type])
        name = f"llvm.masked.store.v{LANES}f32.p0"
        function = cgutils.get_or_insert_function(builder.module, kind, name)
        builder.call(function, [args[2], pointer, INT(4), mask])
        return context.get_dummy_value()

    return types.void(memory, types.intp, Vector, types.intp), generate


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


@intrinsic
def read(typing: Any, memory: Any, index: Any) -> Any:
    """One float32."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.load(emit_address(context, builder, signature.args[0], *args))

    return types.float32(memory, types.intp), generate


@intrinsic
def write(typing: Any, memory: Any, index: Any, value: Any) -> Any:
    """Set one float32."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        builder.store(args[2], emit_address(context, builder, signature.args[0], *args[:2]))
        return context.get_dummy_value()

    return types.void(memory, types.intp, types.float32), generate


@intrinsic
def read_index(typing: Any, address: Any, index: Any) -> Any:
    """One int64 of those at an address."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        wide = ir.IntType(64)
        pointer = builder.inttoptr(args[0], wide.as_pointer())
        return builder.load(builder.gep(pointer, [args[1]]))

    return types.int64(types.intp, types.intp), generate


@intrinsic
def write_index(typing: Any, address: Any, index: Any, value: Any) -> Any:
    """Set one int64 of those at an address."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = builder.inttoptr(args[0], ir.IntType(64).as_pointer())
        builder.store(args[2], builder.gep(pointer, [args[1]]))
        return context.get_dummy_value()

    return types.void(types.intp, types.intp, types.int64), generate


@intrinsic
def copy_quad(typing: Any, out: Any, start: Any, memory: Any, index: Any) -> Any:
    """Copy four float32 from ``index`` of one memory to ``start`` of another."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = ir.VectorType(FLOAT, 4).as_pointer()
        source = emit_address(context, builder, signature.args[2], *args[2:])
        target = emit_address(context, builder, signature.args[0], *args[:2])
        value = builder.load(builder.bitcast(source, pointer), typ=pointer.pointee)
        value.align = 4
        builder.store(value, builder.bitcast(target, pointer)).align = 4
        return context.get_dummy_value()

    return types.void(out, types.intp, memory, types.intp), generate


@intrinsic
def prefetch(typing: Any, memory: Any, index: Any) -> Any:
    """Ask for the cache line around ``index``; harmless where nothing is."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        pointer = emit_address(context, builder, signature.args[0], *args)
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, INT, INT, INT])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        builder.call(function, [pointer, INT(0), INT(3), INT(1)])
        return context.get_dummy_value()

    return types.void(memory, types.intp), generate
