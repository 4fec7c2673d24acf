"""Memory of compiled kernels: loads and stores of single numbers and of vectors.

Memory is a flat contiguous array or, as an integer, an address of float32 numbers. Loops over rows
want addresses: Numba counts the references to an array whenever it is passed on, and threads that
do so with the same array wait for each other. The caller keeps the memory alive.

Offsets count numbers. None of these check bounds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import carray, types
from numba.core import cgutils
from numpy import float32

from chronoscene.kernels.compilation import inner
from chronoscene.kernels.vectors import (
    FLOAT,
    I32,
    LANES,
    Vector,
    emit_lanes,
    emit_shuffle,
    emit_splat,
    emitted,
    splat,
)

_I64 = ir.IntType(64)


def emit_address(
    context: Any, builder: Any, kind: Any, memory: Any, index: Any, element: ir.Type = FLOAT
) -> Any:
    """Pointer to a number; ``element`` is its type where the memory is an address."""
    if isinstance(kind, types.Integer):
        base = builder.inttoptr(memory, element.as_pointer())
    else:
        base = context.make_array(kind)(context, builder, memory).data
    return builder.gep(base, [index])


def emit_load(builder: Any, address: Any, lanes: int = LANES) -> Any:
    """Vector of consecutive numbers."""
    pointer = ir.VectorType(address.type.pointee, lanes).as_pointer()
    return builder.load(builder.bitcast(address, pointer), align=4)


def emit_store(builder: Any, value: Any, address: Any) -> None:
    builder.store(value, builder.bitcast(address, value.type.as_pointer()), align=4)


# Single numbers.


def _make_read(number: types.Type, element: ir.Type) -> Callable:
    @emitted(lambda memory, index: number(memory, types.intp))
    def read(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        memory, index = args
        return builder.load(emit_address(context, builder, sig.args[0], memory, index, element))

    return read


def _make_write(number: types.Type, element: ir.Type) -> Callable:
    @emitted(lambda memory, index, value: types.void(memory, types.intp, number))
    def write(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        memory, index, value = args
        address = emit_address(context, builder, sig.args[0], memory, index, element)
        builder.store(value, address)

    return write


read, write = _make_read(types.float32, FLOAT), _make_write(types.float32, FLOAT)
"""One float32."""
read_index, write_index = _make_read(types.int64, _I64), _make_write(types.int64, _I64)
"""One int64 of those at an address."""


@emitted(lambda address: types.voidptr(types.intp))
def _pointer_to(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    return builder.inttoptr(args[0], context.get_value_type(types.voidptr))


@inner
def floats_at(address, count):  # type: ignore[no-untyped-def]
    """Return the float32 numbers at an address as an array."""
    return carray(_pointer_to(address), (count,), float32)


@emitted(lambda array, offset, amount: types.int64(array, types.intp, types.int64))
def fetch_add(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Add to an element of an int64 array atomically and return its old value.

    A thread that sees the sum also sees what this thread wrote before.
    """
    address = emit_address(context, builder, sig.args[0], *args[:2])
    return builder.atomic_rmw("add", address, args[2], "acq_rel")


@emitted(lambda array, offset: types.int64(array, types.intp))
def load_shared(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Load an element of an int64 array that other threads change."""
    return builder.load_atomic(emit_address(context, builder, sig.args[0], *args), "acquire", 8)


def _make_prefetch(write: int) -> Callable:
    @emitted(lambda memory, index: types.void(memory, types.intp))
    def prefetch(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Prefetch the cache line around ``index``; harmless beyond the end of the memory."""
        pointer = emit_address(context, builder, sig.args[0], *args)
        pointer = builder.bitcast(pointer, ir.IntType(8).as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [pointer.type, I32, I32, I32])
        function = cgutils.get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        # Write or read, keep in all caches, data.
        builder.call(function, [pointer, I32(write), I32(3), I32(1)])

    return prefetch


prefetch, prefetch_write = _make_prefetch(0), _make_prefetch(1)


# Vectors.


def make_load(lanes: int) -> Callable:
    """Make a function that reads vectors with this number of lanes."""

    def loaded(memory: Any, index: Any) -> Any:
        integers = getattr(memory, "dtype", types.float32) == types.int32
        return Vector("i32" if integers else "f32", lanes)(memory, types.intp)

    @emitted(loaded)
    def load(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Vector of consecutive numbers from ``index`` on."""
        return emit_load(builder, emit_address(context, builder, sig.args[0], *args), lanes)

    return load


load = make_load(LANES)


@emitted(lambda memory, index, value: types.void(memory, types.intp, value))
def store(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write a vector to consecutive numbers from ``index`` on."""
    emit_store(builder, args[2], emit_address(context, builder, sig.args[0], *args[:2]))


def _make_load_pairs(upper: bool) -> Callable:
    @emitted(lambda memory, rows: Vector("f32", rows.lanes)(memory, rows))
    def load_pairs(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        """Two numbers of each row of [.., 2] that half of the lanes name; rows are int32."""
        half = sig.args[1].lanes // 2
        start = emit_address(context, builder, sig.args[0], args[0], _I64(0))
        start = builder.bitcast(start, _I64.as_pointer())
        pairs = ir.Constant(ir.VectorType(_I64, half), ir.Undefined)
        for i in range(half):
            row = builder.extract_element(args[1], I32(half * upper + i))
            pair = builder.load(builder.gep(start, [builder.zext(row, _I64)]), align=4)
            pairs = builder.insert_element(pairs, pair, I32(i))
        return builder.bitcast(pairs, sig.return_type.llvm)

    return load_pairs


load_low_pairs, load_high_pairs = _make_load_pairs(upper=False), _make_load_pairs(upper=True)


@emitted(lambda array, offset, mask, value: types.void(array, types.intp, mask, value))
def store_where(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write the lanes of a vector whose mask is set. The others are written too, as they were."""
    address = emit_address(context, builder, sig.args[0], *args[:2])
    old = emit_load(builder, address, sig.args[3].lanes)
    emit_store(builder, builder.select(args[2], args[3], old), address)


def _emit_first_lanes(builder: Any, count: Any, lanes: int) -> Any:
    """Mask of the lanes below ``count``, any integer."""
    wide = count.type
    clipped = builder.select(builder.icmp_signed("<", count, wide(lanes)), count, wide(lanes))
    counts = emit_splat(builder, builder.trunc(clipped, I32), lanes)
    return builder.icmp_signed("<", emit_lanes(range(lanes), I32), counts)


def _emit_masked(builder: Any, name: str, result: ir.Type, args: list[Any], lanes: int) -> Any:
    """Call ``llvm.masked.<name>`` on floats."""
    kind = ir.FunctionType(result, [arg.type for arg in args])
    full = f"llvm.masked.{name}.v{lanes}f32.p0"
    return builder.call(cgutils.get_or_insert_function(builder.module, kind, full), args)


@emitted(lambda memory, index, count: Vector("f32", LANES)(memory, types.intp, types.intp))
def load_first(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Read the first ``count`` of LANES lanes, and nothing beyond; the others are 0."""
    result = sig.return_type.llvm
    address = emit_address(context, builder, sig.args[0], *args[:2])
    pointer = builder.bitcast(address, result.as_pointer())
    mask = _emit_first_lanes(builder, args[2], LANES)
    zeros = emit_lanes([0.0] * LANES, FLOAT)
    return _emit_masked(builder, "load", result, [pointer, I32(4), mask, zeros], LANES)


@emitted(lambda memory, index, value, count: types.void(memory, types.intp, value, types.intp))
def store_first(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write the first ``count`` lanes and nothing beyond."""
    lanes = sig.args[2].lanes
    address = emit_address(context, builder, sig.args[0], *args[:2])
    pointer = builder.bitcast(address, args[2].type.as_pointer())
    mask = _emit_first_lanes(builder, args[3], lanes)
    _emit_masked(builder, "store", ir.VoidType(), [args[2], pointer, I32(4), mask], lanes)


@emitted(lambda out, start, memory, index: types.void(out, types.intp, memory, types.intp))
def copy_quad(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Copy four float32 from ``index`` of one memory to ``start`` of another."""
    source = emit_address(context, builder, sig.args[2], *args[2:])
    target = emit_address(context, builder, sig.args[0], *args[:2])
    emit_store(builder, emit_load(builder, source, 4), target)


@emitted(lambda out, start, memory, index: types.void(out, types.intp, memory, types.intp))
def store_cycle(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Write three numbers over and over, 3 LANES in all.

    Reads LANES numbers from ``index`` on, so those must exist.
    """
    out, start, memory, index = args
    value = emit_load(builder, emit_address(context, builder, sig.args[2], memory, index))
    for part in range(3):
        order = [(part * LANES + i) % 3 for i in range(LANES)]
        at = builder.add(start, start.type(part * LANES))
        target = emit_address(context, builder, sig.args[0], out, at)
        emit_store(builder, emit_shuffle(builder, value, value, order), target)


@inner
def set_zero(memory, start, stop):  # type: ignore[no-untyped-def]
    """Set the numbers start..stop to zero."""
    for i in range(start, stop, LANES):
        store_first(memory, i, splat(float32(0)), stop - i)


@emitted(lambda addresses, count: addresses(addresses, types.intp))
def moved(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Named tuple of addresses, each ``count`` float32 further."""
    move = builder.mul(args[1], args[1].type(4))
    parts = cgutils.unpack_tuple(builder, args[0], len(sig.args[0]))
    return context.make_tuple(builder, sig.return_type, [builder.add(x, move) for x in parts])


def place(sizes: Sequence[int], address: int) -> list[int]:
    """Addresses of arrays of float32 that lie one after the other."""
    return [address + 4 * sum(sizes[:i]) for i in range(len(sizes))]
