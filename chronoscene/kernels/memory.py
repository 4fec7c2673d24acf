"""Memory of compiled kernels: loads and stores of vectors and single numbers.

Memory is a flat float32 array or, as an integer, an address. Loops over rows want addresses: Numba
counts the references to an array whenever it is passed on, and threads that do so with the same
array wait for each other. The caller keeps the memory alive.

None of these check bounds.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils

from chronoscene.kernels.registers import (
    FLOAT,
    FLOATS,
    INT,
    INTS,
    LANES,
    Vector,
    emit_address,
    emit_constant,
    emit_load,
    emit_store,
    intrinsic,
)


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
