"""Elementary functions of vectors."""

from __future__ import annotations

from typing import Any

from chronoscene.rasterizer.cpu.kernel import inlined
from chronoscene.rasterizer.cpu.simd import as_float, as_int, to_float

ROUND = 12582912.0
"""1.5 * 2^23: adding it leaves the nearest whole number in the low bits."""


@inlined
def exp2(x: Any, shifted: Any) -> Any:
    """2^x for -126 < x < 127, relative error below 2.4e-7; some other number outside.

    Polynomial of least maximal relative error on half an octave either side of a whole number,
    evaluated by pairs: what waits for it is longer than the arithmetic.

    Args:
        x: Exponents.
        shifted: x + ROUND, which the caller may have sooner than x.
    """
    exponent = as_int(shifted) << 23
    f = x - (shifted - ROUND)
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
