"""Functions of vectors of any number of lanes: exponentials, logarithms, sums over lanes."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from numba import types
from numpy import float32

from chronoscene.kernels.compilation import inlined, inner
from chronoscene.kernels.vectors import (
    I32,
    as_float,
    as_int,
    emit_shuffle,
    emitted,
    multiply_add,
    select,
    to_float,
)

LOG2_E = float32(1 / math.log(2))
# ln 2 in two parts: the first has few digits, so that its product with an integer is exact.
LN2_HIGH = float32(0.693359375)
LN2_LOW = float32(math.log(2) - 0.693359375)
ROUNDER = float32(1.5 * 2**23)
"""Adding it rounds to an integer, which then stands in the lowest bits."""
EXP_MIN = float32(-86.5)  # Below, exp would leave the normal numbers; it stays at 2.7e-38
EXP_MAX = float32(88.3)  # Above, exp is infinite
INFINITY = float32(math.inf)
# Taylor coefficients 1 / n! of exp; the rest at |x| <= ln(2) / 2 is 1e-8 of the value.
EXP_TAYLOR = tuple(float32(1 / math.factorial(n)) for n in range(8))
# Of tanh(x) / x in x²: 2e-7 wrong at most up to `TANH_SERIES_END`.
TANH_TAYLOR = tuple(float32(c) for c in (1, -1 / 3, 2 / 15, -17 / 315, 62 / 2835, -1382 / 155925))
TANH_SERIES_END = float32(0.35)
ZERO, ONE, TWO = float32(0), float32(1), float32(2)


@emitted(lambda value: types.float32(value))
def lane_sum(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Sum of all lanes, halves added to halves: the order is fixed."""
    total, lanes = args[0], sig.args[0].lanes
    half = lanes // 2
    while half:
        order = [(i + half) % lanes for i in range(lanes)]
        total = builder.fadd(total, emit_shuffle(builder, total, total, order))
        half //= 2
    return builder.extract_element(total, I32(0))


@emitted(lambda value: value(value))
def quad_sum(context: Any, builder: Any, sig: Any, args: Any) -> Any:
    """Sum of each four neighbouring lanes, in all four of them."""
    total = args[0]
    for distance in (1, 2):
        order = [i ^ distance for i in range(sig.args[0].lanes)]
        total = builder.fadd(total, emit_shuffle(builder, total, total, order))
    return total


def _make_permutation(source: Callable[[int, int], int]) -> Callable:
    """Make a function that moves lanes; ``source(i, lanes)`` is where lane i comes from."""

    @emitted(lambda value: value(value))
    def permute(context: Any, builder: Any, sig: Any, args: Any) -> Any:
        lanes = sig.args[0].lanes
        return emit_shuffle(builder, args[0], args[0], [source(i, lanes) for i in range(lanes)])

    return permute


quad_heads = _make_permutation(lambda i, lanes: 4 * i % lanes)
"""The first of each four lanes, moved to the front."""
quad_spread = _make_permutation(lambda i, lanes: i // 4)
"""The first lanes, each four times: the reverse of `quad_heads`."""
low_pairs = _make_permutation(lambda i, lanes: i // 2)
"""The lanes of the first half, each twice."""
high_pairs = _make_permutation(lambda i, lanes: (lanes + i) // 2)
"""The lanes of the second half, each twice."""


@inner
def exp(x):  # type: ignore[no-untyped-def]
    """e to the x, within 1.2e-7 of its value; nan stays nan.

    With n = round(x / ln 2): e^x = 2^n e^(x - n ln 2), a Taylor polynomial of the rest.
    """
    clipped = select(x < EXP_MIN, EXP_MIN, select(x > EXP_MAX, EXP_MAX, x))
    rounded = multiply_add(clipped, LOG2_E, ROUNDER)
    n = rounded - ROUNDER
    rest = multiply_add(n, -LN2_HIGH, clipped)
    rest = multiply_add(n, -LN2_LOW, rest)
    total = multiply_add(rest, EXP_TAYLOR[7], EXP_TAYLOR[6])
    for i in range(5, -1, -1):
        total = multiply_add(total, rest, EXP_TAYLOR[i])
    # n is in the lowest bits of `rounded`; the exponent of a float32 begins at bit 23.
    return select(x > EXP_MAX, INFINITY, as_float(as_int(total) + (as_int(rounded) << 23)))


@inner
def sigmoid(x):  # type: ignore[no-untyped-def]
    """1 / (1 + exp(-x))."""
    return ONE / (exp(ZERO - x) + ONE)


@inner
def tanh(x):  # type: ignore[no-untyped-def]
    """Hyperbolic tangent, 1 - 2 / (e^2x + 1); by its series where small numbers would lose their
    sign and digits."""
    square = x * x
    series = multiply_add(square, TANH_TAYLOR[5], TANH_TAYLOR[4])
    for i in range(3, -1, -1):
        series = multiply_add(series, square, TANH_TAYLOR[i])
    far = ONE - TWO / (exp(x + x) + ONE)
    return select(square < TANH_SERIES_END * TANH_SERIES_END, x * series, far)


@inlined
def exp2(x: Any, shifted: Any) -> Any:
    """2^x for -126 < x < 127, relative error below 2.4e-7; some other number outside.

    Polynomial of least maximal relative error on half an octave either side of a whole number,
    evaluated by pairs: what waits for it is longer than the arithmetic.

    Args:
        x: Exponents.
        shifted: x + ROUNDER, which the caller may have sooner than x.
    """
    exponent = as_int(shifted) << 23
    f = x - (shifted - ROUNDER)
    ff = f * f
    low = f * 0.6931469440460205 + 1.0000001192092896
    middle = f * 0.05550713092088699 + 0.24022120237350464
    high = f * 0.0013276472454890609 + 0.009675540961325169
    p = (high * ff + middle) * ff + low
    return as_float(as_int(p) + exponent)


@inlined
def log2(x: Any) -> Any:
    """Base-2 logarithm of normal positive numbers, absolute error below 3e-7 near 1.

    x = 2^n m with m between sqrt(1/2) and sqrt(2); log m is the series of 2 artanh((m-1)/(m+1)).
    """
    bits = as_int(x) - 0x3F3504F3  # sqrt(1/2)
    n = bits >> 23
    m = as_float((bits & 0x007FFFFF) + 0x3F3504F3)
    t = (m - 1.0) / (m + 1.0)
    s = t * t
    p = s * 0.32059889 + 0.41219858
    p = p * s + 0.57707802
    p = p * s + 0.96179669
    p = p * s + 2.88539008
    return to_float(n) + t * p
