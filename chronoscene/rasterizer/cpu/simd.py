"""What the kernels do with vectors of 8 or 16 numbers: memory, functions, and lanes that move.

The vectors themselves and their operators are in `chronoscene.kernels.simd`.

All arrays must be one-dimensional and contiguous; offsets count elements and are not checked.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from llvmlite import ir
from numba import types

from chronoscene.kernels.simd import (
    ELEMENTS,
    FLAGS,
    I32,
    REGISTER_LANES,
    Vector,
    comparison,
    emit_lanes,
    emit_promoted,
    intrinsic,
    make_splat,
)

LANES = max(REGISTER_LANES, 8)
"""Numbers in the vectors of the kernels."""


def _shuffle(builder: Any, a: Any, b: Any, lanes: Sequence[int | None]) -> Any:
    """Lanes of a, then of b, by number; None is any value."""
    free = a.type.count - 1
    return builder.shuffle_vector(
        a,
        b,
        emit_lanes([min(k, free) if i is None else i for k, i in enumerate(lanes)], I32),
    )


def _pick(builder: Any, sources: list[Any], lanes: list[tuple[int, int]]) -> Any:
    """Vector of (source, lane) pairs taken from any number of vectors of one width."""
    width, n = sources[0].type.count, len(lanes)
    result, placed = None, set[int]()
    for first in range(0, len(sources), 2):
        pair = [sources[first], sources[min(first + 1, len(sources) - 1)]]
        here = {i for i, (source, _) in enumerate(lanes) if source - first in (0, 1)}
        if not here:
            continue
        wanted = [
            (source - first) * width + lane if i in here else None
            for i, (source, lane) in enumerate(lanes)
        ]
        piece = _shuffle(builder, pair[0], pair[1], wanted)
        if result is None:
            result = piece
        else:
            merged = [n + i if i in here else i if i in placed else None for i in range(n)]
            result = _shuffle(builder, result, piece, merged)
        placed |= here
    return result


def _address(context: Any, builder: Any, array_type: Any, array: Any, offset: Any) -> Any:
    data = context.make_array(array_type)(context, builder, array).data
    return builder.gep(data, [offset])


def _vector_address(
    context: Any, builder: Any, array_type: Any, array: Any, offset: Any, lanes: int
) -> Any:
    address = _address(context, builder, array_type, array, offset)
    return builder.bitcast(address, ir.VectorType(address.type.pointee, lanes).as_pointer())


def _load(context: Any, builder: Any, array_type: Any, array: Any, offset: Any, lanes: int) -> Any:
    address = _vector_address(context, builder, array_type, array, offset, lanes)
    return builder.load(address, align=4)


def _offset(builder: Any, offset: Any, more: int) -> Any:
    return builder.add(offset, ir.Constant(offset.type, more))


_KINDS = {types.float32: "f32", types.int32: "i32"}


def _make_load(lanes: int) -> Callable:
    @intrinsic
    def load(typingctx: Any, array: Any, offset: Any) -> Any:
        """Vector of consecutive elements."""
        result = Vector(_KINDS[array.dtype], lanes)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return _load(context, builder, sig.args[0], args[0], args[1], lanes)

        return result(array, types.intp), codegen

    return load


load = _make_load(LANES)
load16 = _make_load(16)


@intrinsic
def store(typingctx: Any, array: Any, offset: Any, value: Any) -> Any:
    """Write a vector to consecutive elements."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _vector_address(
            context, builder, sig.args[0], args[0], args[1], sig.args[2].lanes
        )
        builder.store(args[2], address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, value), codegen


@intrinsic
def store_where(typingctx: Any, array: Any, offset: Any, mask: Any, value: Any) -> Any:
    """Write the lanes of a vector whose mask is set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _vector_address(
            context, builder, sig.args[0], args[0], args[1], sig.args[3].lanes
        )
        old = builder.load(address, align=4)
        builder.store(builder.select(args[2], args[3], old), address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, mask, value), codegen


splat = make_splat("f32", LANES)
splat_int = make_splat("i32", LANES)
splat16 = make_splat("f32", 16)
splat16_int = make_splat("i32", 16)


def make_constant(values: list[int] | list[float]) -> Callable:
    """Function of no arguments for use in kernels that gives these lanes."""
    kind = "i32" if all(isinstance(v, int) for v in values) else "f32"

    @intrinsic
    def constant(typingctx: Any) -> Any:
        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            return emit_lanes(values, ELEMENTS[kind])

        return Vector(kind, len(values))(), codegen

    return constant


def _intrinsic_call(builder: Any, name: str, args: list[Any]) -> Any:
    """Call ``llvm.<name>`` on vectors of one type."""
    vector = args[0].type
    full = f"llvm.{name}.v{vector.count}f32"
    module = builder.module
    function = module.globals.get(full)
    if function is None:
        function = ir.Function(module, ir.FunctionType(vector, [vector] * len(args)), name=full)
    return builder.call(function, args, fastmath=FLAGS)


@intrinsic
def sqrt(typingctx: Any, a: Any) -> Any:
    """Square root of each lane; nan for negative ones."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _intrinsic_call(builder, "sqrt", list(args))

    return a(a), codegen


@intrinsic
def floor(typingctx: Any, a: Any) -> Any:
    """Largest whole number not above each lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _intrinsic_call(builder, "floor", list(args))

    return a(a), codegen


@intrinsic
def absolute(typingctx: Any, a: Any) -> Any:
    """Absolute value of each lane."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _intrinsic_call(builder, "fabs", list(args))

    return a(a), codegen


@intrinsic
def multiply_add(typingctx: Any, a: Any, b: Any, c: Any) -> Any:
    """a * b + c, rounded once where the processor can."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return _intrinsic_call(builder, "fmuladd", list(args))

    return a(a, b, c), codegen


@intrinsic
def select(typingctx: Any, mask: Any, a: Any, b: Any) -> Any:
    """Lanes of ``a`` where the mask is set, of ``b`` elsewhere. Either may be a number."""
    like = a if isinstance(a, Vector) else b

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        yes = emit_promoted(context, builder, args[1], sig.args[1], like)
        no = emit_promoted(context, builder, args[2], sig.args[2], like)
        return builder.select(args[0], yes, no)

    return like(mask, a, b), codegen


def _make_extremum(symbol: str) -> Callable:
    @intrinsic
    def extremum(typingctx: Any, a: Any, b: Any) -> Any:
        """The smaller (larger) of two per lane; the second if one is nan."""
        like = a if isinstance(a, Vector) else b

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            x = emit_promoted(context, builder, args[0], sig.args[0], like)
            y = emit_promoted(context, builder, args[1], sig.args[1], like)
            return builder.select(comparison(symbol)(builder, like.kind, x, y), x, y)

        return like(a, b), codegen

    return extremum


minimum = _make_extremum("<")
maximum = _make_extremum(">")


@intrinsic
def to_int(typingctx: Any, a: Any) -> Any:
    """Lanes truncated towards zero; they must fit."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.fptosi(args[0], sig.return_type.llvm)

    return a.with_kind("i32")(a), codegen


@intrinsic
def to_float(typingctx: Any, a: Any) -> Any:
    """Integer lanes as floats."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.sitofp(args[0], sig.return_type.llvm)

    return a.with_kind("f32")(a), codegen


@intrinsic
def as_int(typingctx: Any, a: Any) -> Any:
    """The bits of float lanes."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], sig.return_type.llvm)

    return a.with_kind("i32")(a), codegen


@intrinsic
def as_float(typingctx: Any, a: Any) -> Any:
    """Float lanes of these bits."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.bitcast(args[0], sig.return_type.llvm)

    return a.with_kind("f32")(a), codegen


@intrinsic
def any_lane(typingctx: Any, mask: Any) -> Any:
    """Whether any lane of the mask is set."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        bits = builder.bitcast(args[0], ir.IntType(sig.args[0].lanes))
        return builder.icmp_unsigned("!=", bits, ir.Constant(bits.type, 0))

    return types.boolean(mask), codegen


@intrinsic
def pack_bytes(typingctx: Any, a: Any) -> Any:
    """The low bytes of eight integer lanes as one 64-bit number, lane 0 lowest."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        low = builder.trunc(args[0], ir.VectorType(ir.IntType(8), 8))
        return builder.bitcast(low, ir.IntType(64))

    return types.uint64(a), codegen


@intrinsic
def trailing_zeros(typingctx: Any, bits: Any) -> Any:
    """Number of the lowest set bit of a nonzero 64-bit number."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return types.intp(types.uint64), codegen


def _make_prefetch(write: int) -> Callable:
    @intrinsic
    def prefetch(typingctx: Any, array: Any, offset: Any) -> Any:
        """Ask for the cache line of an element."""

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            address = _address(context, builder, sig.args[0], *args)
            address = builder.bitcast(address, ir.IntType(8).as_pointer())
            name = "llvm.prefetch.p0"
            function = builder.module.globals.get(name)
            if function is None:
                kinds = [address.type, I32, I32, I32]
                function = ir.Function(
                    builder.module, ir.FunctionType(ir.VoidType(), kinds), name=name
                )
            # Write or read, keep in all caches, data.
            builder.call(function, [address, *(ir.Constant(I32, v) for v in (write, 3, 1))])
            return context.get_dummy_value()

        return types.void(array, types.intp), codegen

    return prefetch


prefetch = _make_prefetch(0)
prefetch_write = _make_prefetch(1)


@intrinsic
def fetch_add(typingctx: Any, array: Any, offset: Any, amount: Any) -> Any:
    """Add to an element of an int64 array as one atomic step; what it was before.

    What this thread wrote before is seen by a thread that sees the sum.
    """

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        return builder.atomic_rmw("add", address, args[2], "acq_rel")

    return types.int64(array, types.intp, types.int64), codegen


@intrinsic
def load_shared(typingctx: Any, array: Any, offset: Any) -> Any:
    """An element of an int64 array that other threads change, as it is now."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        address = _address(context, builder, sig.args[0], args[0], args[1])
        return builder.load_atomic(address, "acquire", 8)

    return types.int64(array, types.intp), codegen


def _make_load_columns(count: int) -> Callable:
    @intrinsic
    def load_columns(typingctx: Any, array: Any, offset: Any) -> Any:
        """Columns of `LANES` consecutive rows of a matrix, one vector each."""
        result = types.UniTuple(Vector("f32", LANES), count)

        def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
            rows = [
                _load(
                    context,
                    builder,
                    sig.args[0],
                    args[0],
                    _offset(builder, args[1], i * LANES),
                    LANES,
                )
                for i in range(count)
            ]
            flat = [[count * i + c for i in range(LANES)] for c in range(count)]
            columns = [
                _pick(builder, rows, [(k // LANES, k % LANES) for k in column]) for column in flat
            ]
            return context.make_tuple(builder, sig.return_type, columns)

        return result(array, types.intp), codegen

    return load_columns


load3 = _make_load_columns(3)
load4 = _make_load_columns(4)


@intrinsic
def store_columns(typingctx: Any, array: Any, offset: Any, columns: Any) -> Any:
    """Write vectors as the columns of `LANES` consecutive rows of a matrix."""
    count = len(columns)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        from numba.core import cgutils

        vectors = cgutils.unpack_tuple(builder, args[2], count)
        for i in range(count):
            flat = range(i * LANES, (i + 1) * LANES)
            row = _pick(builder, vectors, [(k % count, k // count) for k in flat])
            address = _vector_address(
                context,
                builder,
                sig.args[0],
                args[0],
                _offset(builder, args[1], i * LANES),
                LANES,
            )
            builder.store(row, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, columns), codegen


def _transpose(builder: Any, vectors: list[Any]) -> list[Any]:
    """Rows from columns, by log2(n) rounds of interleaving the two halves of the list."""
    n = len(vectors)
    low: list[int | None] = [i // 2 + (i % 2) * n for i in range(n)]
    high: list[int | None] = [n // 2 + i // 2 + (i % 2) * n for i in range(n)]
    for _ in range(n.bit_length() - 1):
        halves = zip(vectors[: n // 2], vectors[n // 2 :], strict=True)
        vectors = [_shuffle(builder, a, b, lanes) for a, b in list(halves) for lanes in (low, high)]
    return vectors


@intrinsic
def store_records(typingctx: Any, array: Any, offset: Any, fields: Any) -> Any:
    """Write 16 vectors as `LANES` records of 16 numbers."""

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        from numba.core import cgutils

        vectors = cgutils.unpack_tuple(builder, args[2], 16)
        for part in range(0, 16, LANES):
            for i, row in enumerate(_transpose(builder, vectors[part : part + LANES])):
                at = _offset(builder, args[1], 16 * i + part)
                address = _vector_address(context, builder, sig.args[0], args[0], at, LANES)
                builder.store(row, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, fields), codegen


@intrinsic
def load_records(typingctx: Any, array: Any, offset: Any) -> Any:
    """The 16 fields of `LANES` records of 16 numbers, one vector each."""
    result = types.UniTuple(Vector("f32", LANES), 16)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        fields = []
        for part in range(0, 16, LANES):
            rows = [
                _load(
                    context,
                    builder,
                    sig.args[0],
                    args[0],
                    _offset(builder, args[1], 16 * i + part),
                    LANES,
                )
                for i in range(LANES)
            ]
            fields += _transpose(builder, rows)
        return context.make_tuple(builder, sig.return_type, fields)

    return result(array, types.intp), codegen


def _pairwise_sums(builder: Any, vectors: list[Any]) -> Any:
    """Vector whose lane i is the sum of the lanes of vector i; None counts as zeros.

    Rounds of adding halves of pairs of vectors, first within groups of four lanes, where shuffles
    are cheap, then across: the order of summation is fixed.
    """
    lanes = next(v for v in vectors if v is not None).type.count
    groups = lanes // 4
    inner = [
        ([0, lanes, 1, lanes + 1], [2, lanes + 2, 3, lanes + 3]),
        ([0, 1, lanes, lanes + 1], [2, 3, lanes + 2, lanes + 3]),
    ]
    rounds = [
        tuple([4 * g + i for g in range(groups) for i in half] for half in halves)
        for halves in inner
    ]
    while groups > 1:
        # Two vectors of `width` live groups each are folded into one.
        both = list(range(0, lanes // 4, 2)), list(range(1, lanes // 4, 2))
        rounds.append(
            tuple(
                [4 * g + i + part * lanes for part in (0, 1) for g in half for i in range(4)]
                for half in both
            )
        )
        groups //= 2
    for low, high in rounds:
        folded: list[Any] = []
        for a, b in zip(vectors[0::2], vectors[1::2], strict=True):
            if a is None and b is None:
                folded.append(None)
                continue
            zeros = ir.Constant((a or b).type, None)
            x, y = (zeros if v is None else v for v in (a, b))
            folded.append(
                builder.fadd(
                    _shuffle(builder, x, y, low),
                    _shuffle(builder, x, y, high),
                    flags=FLAGS,
                )
            )
        vectors = folded
    return vectors


@intrinsic
def store_sums(typingctx: Any, array: Any, offset: Any, vectors: Any) -> Any:
    """Write the sum over the lanes of each vector as one row of 16 numbers; the rest is 0."""
    count = len(vectors)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        from numba.core import cgutils

        given = cgutils.unpack_tuple(builder, args[2], count)
        sums = _pairwise_sums(builder, given + [None] * (16 - count))
        for part, vector in enumerate(sums):
            at = _offset(builder, args[1], part * LANES)
            address = _vector_address(context, builder, sig.args[0], args[0], at, LANES)
            zeros = ir.Constant(ir.VectorType(ir.FloatType(), LANES), None)
            builder.store(zeros if vector is None else vector, address, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, vectors), codegen


@intrinsic
def store_pixels(typingctx: Any, array: Any, offset: Any, stride: Any, channels: Any) -> Any:
    """Write rows of four pixels, ``stride`` numbers apart, with interleaved channels."""
    count = len(channels)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        from numba.core import cgutils

        vectors, at = cgutils.unpack_tuple(builder, args[3], count), args[1]
        for row in range(LANES // 4):
            for first in range(0, count, 2):
                flat = range(4 * first, 4 * min(first + 2, count))
                picks = [(k % count, 4 * row + k // count) for k in flat]
                address = _vector_address(
                    context,
                    builder,
                    sig.args[0],
                    args[0],
                    _offset(builder, at, 4 * first),
                    len(flat),
                )
                builder.store(_pick(builder, vectors, picks), address, align=4)
            at = builder.add(at, args[2])
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, channels), codegen


@intrinsic(prefer_literal=True)
def load_pixels(typingctx: Any, array: Any, offset: Any, stride: Any, channels: Any) -> Any:
    """Channels, 1 or 3, of rows of four pixels, ``stride`` numbers apart."""
    count = channels.literal_value
    result = types.UniTuple(Vector("f32", LANES), count)

    def codegen(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        at, parts = args[1], []
        for _ in range(LANES // 4):
            for first in range(count):
                four = _load(
                    context,
                    builder,
                    sig.args[0],
                    args[0],
                    _offset(builder, at, 4 * first),
                    4,
                )
                parts.append(four)
            at = builder.add(at, args[2])
        vectors = []
        for c in range(count):
            flat = [(lane // 4, count * (lane % 4) + c) for lane in range(LANES)]
            vectors.append(
                _pick(builder, parts, [(count * row + k // 4, k % 4) for row, k in flat])
            )
        return context.make_tuple(builder, sig.return_type, vectors)

    return result(array, types.intp, types.intp, channels), codegen
