"""Functions of vectors: sums over lanes, patterns, exponentials."""

from __future__ import annotations

import math
from typing import Any

from llvmlite import ir
from numba import types
from numba.core import cgutils
from numpy import float32

from chronoscene.kernels.registers import (
    FLOATS,
    INT,
    INTS,
    LANES,
    Vector,
    emit_address,
    emit_load,
    emit_store,
    intrinsic,
    multiply_add,
    select_less,
    splat,
)
from chronoscene.kernels.training_compilation import inner

LOG2_E = float32(1 / math.log(2))
# ln 2 in two parts: the first has few digits, so that its product with an integer is exact.
LN2_HIGH = float32(0.693359375)
LN2_LOW = float32(math.log(2) - 0.693359375)
ROUNDER = float32(1.5 * 2**23)
"""Adding it rounds to an integer, which then stands in the lowest bits."""
EXP_LOW = float32(-86.5)
"""Below, exp would leave the normal numbers; it stays at 2.7e-38."""
EXP_HIGH = float32(88.3)
"""Above, exp is infinite."""
# Taylor coefficients 1 / n! of exp; the rest at |x| <= ln(2) / 2 is 1e-8 of the value.
EXP_TAYLOR = tuple(float32(1 / math.factorial(n)) for n in range(8))
# Of tanh(x) / x in x²: 2e-7 wrong at most up to `TANH_SERIES_END`.
TANH_TAYLOR = tuple(float32(c) for c in (1, -1 / 3, 2 / 15, -17 / 315, 62 / 2835, -1382 / 155925))
TANH_SERIES_END = float32(0.35)
ZERO = float32(0)
ONE = float32(1)
TWO = float32(2)


def _turned(builder: Any, value: Any, order: list[int]) -> Any:
    return builder.shuffle_vector(value, value, ir.Constant(INTS, order))


@intrinsic
def lane_sum(typing: Any, value: Any) -> Any:
    """Sum of all lanes, halves added to halves: the order is fixed."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total, half = args[0], LANES // 2
        while half:
            order = [(i + half) % LANES for i in range(LANES)]
            total = builder.fadd(total, _turned(builder, total, order))
            half //= 2
        return builder.extract_element(total, INT(0))

    return types.float32(Vector), generate


@intrinsic
def quad_sum(typing: Any, value: Any) -> Any:
    """Sum of each four neighbouring lanes, in all four of them."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        total = args[0]
        for distance in (1, 2):
            order = [i ^ distance for i in range(LANES)]
            total = builder.fadd(total, _turned(builder, total, order))
        return total

    return Vector(Vector), generate


@intrinsic
def quad_heads(typing: Any, value: Any) -> Any:
    """The first of each four lanes, moved to the front."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _turned(builder, args[0], [4 * i % LANES for i in range(LANES)])

    return Vector(Vector), generate


@intrinsic
def quad_spread(typing: Any, value: Any) -> Any:
    """The first lanes, each four times: the reverse of `quad_heads`."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return _turned(builder, args[0], [i // 4 for i in range(LANES)])

    return Vector(Vector), generate


@intrinsic
def quad_identity(typing: Any) -> Any:
    """1, 0, 0, 0 in each four lanes."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return ir.Constant(FLOATS, [1.0 if i % 4 == 0 else 0.0 for i in range(LANES)])

    return Vector(), generate


@intrinsic
def store_cycle(typing: Any, out: Any, start: Any, memory: Any, index: Any) -> Any:
    """Write three numbers over and over, 3 LANES in all.

    Reads LANES numbers from ``index`` on, so those must exist.
    """

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        out, start, memory, index = args
        source = emit_address(context, builder, signature.args[2], memory, index)
        value = emit_load(builder, source)
        for part in range(3):
            order = [(part * LANES + i) % 3 for i in range(LANES)]
            at = builder.add(start, start.type(part * LANES))
            target = emit_address(context, builder, signature.args[0], out, at)
            emit_store(builder, _turned(builder, value, order), target)
        return context.get_dummy_value()

    return types.void(out, types.intp, memory, types.intp), generate


@intrinsic
def any_bit(typing: Any, a: Any, b: Any) -> Any:
    """Bits of both; not 0 or -0 where either is not."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        a, b = (builder.bitcast(value, INTS) for value in args)
        return builder.bitcast(builder.or_(a, b), FLOATS)

    return Vector(Vector, Vector), generate


@intrinsic
def is_zero(typing: Any, value: Any) -> Any:
    """Whether all lanes are 0 or -0."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        magnitude = builder.shl(builder.bitcast(args[0], INTS), ir.Constant(INTS, [1] * LANES))
        zeros = builder.icmp_signed("==", magnitude, ir.Constant(INTS, [0] * LANES))
        packed = builder.bitcast(zeros, ir.IntType(LANES))
        return builder.icmp_signed("==", packed, ir.Constant(packed.type, -1))

    return types.boolean(Vector), generate


@intrinsic
def square_root(typing: Any, value: Any) -> Any:
    """Root of every lane."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        name = f"llvm.sqrt.v{LANES}f32"
        kind = ir.FunctionType(FLOATS, [FLOATS])
        return builder.call(cgutils.get_or_insert_function(builder.module, kind, name), args)

    return Vector(Vector), generate


@intrinsic
def _shift_exponent(typing: Any, value: Any, rounded: Any) -> Any:
    """value * 2**n, where n stands in the lowest bits of ``rounded``."""

    def generate(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        value, n = (builder.bitcast(arg, INTS) for arg in args)
        exponent = builder.shl(n, ir.Constant(INTS, [23] * LANES))
        return builder.bitcast(builder.add(value, exponent), FLOATS)

    return Vector(Vector, Vector), generate


@inner
def exp(x):  # type: ignore[no-untyped-def]
    """e to the x, within 1.2e-7 of its value. What is not a number stays so."""
    low = splat(EXP_LOW)
    high = splat(EXP_HIGH)
    clipped = select_less(x, low, low, select_less(high, x, high, x))
    rounded = multiply_add(clipped, splat(LOG2_E), splat(ROUNDER))
    n = rounded - ROUNDER
    rest = multiply_add(n, splat(-LN2_HIGH), clipped)
    rest = multiply_add(n, splat(-LN2_LOW), rest)
    total = splat(EXP_TAYLOR[7])
    for i in range(6, -1, -1):
        total = multiply_add(total, rest, splat(EXP_TAYLOR[i]))
    return select_less(high, x, splat(float32(math.inf)), _shift_exponent(total, rounded))


@inner
def sigmoid(x):  # type: ignore[no-untyped-def]
    """1 / (1 + exp(-x))."""
    return ONE / (exp(ZERO - x) + ONE)


@inner
def tanh(x):  # type: ignore[no-untyped-def]
    """Hyperbolic tangent; small numbers keep their sign and digits."""
    square = x * x
    series = splat(TANH_TAYLOR[5])
    for i in range(4, -1, -1):
        series = multiply_add(series, square, splat(TANH_TAYLOR[i]))
    far = ONE - TWO / (exp(x + x) + ONE)
    return select_less(square, splat(TANH_SERIES_END * TANH_SERIES_END), x * series, far)
