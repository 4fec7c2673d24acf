"""L1 + SSIM of two images and its gradient, compiled.

Images are rows of 3 W interleaved numbers, so the neighbour of a number is 3 to its right and one
kernel blurs all channels. Rows stand in a frame of zeros: `MARGIN` numbers at both ends, `RADIUS`
rows above and below. With G the blur, x the image and y the target, let

    mu = G(x), nu = G(y), e = mu - nu,
    C = mu² + nu² + C1, D = G(x² + y²) - mu² - nu² + C2, V = G((x - y)²) - e².

The usual numerators are A = 2 mu nu + C1 = C - e² and B = 2 cov(x, y) + C2 = D - V. Hence

    1 - S = e² / C + (A / C) (V / D),

which keeps its digits where the images agree. G being symmetric, the gradient of sum(1 - S) with
respect to x is G(a) + 2 x G(b) + 2 (x - y) G(c) with

    a = 2 e (B / D) (C - mu e) / C² - 2 (A / C) (e D - mu V) / D²,
    b = -(A / C) V / D²,  c = (A / C) / D.

Source: Wang et al. 2004, equation 13; window and padding of 3DGS. The gradient is our derivation.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange
from numpy import float32

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import load, store, store_first
from chronoscene.kernels.vector_math import lane_sum
from chronoscene.kernels.vectors import LANES, multiply_add, select, splat

RADIUS = 5
SIGMA = 1.5
CHANNELS = 3
MARGIN = 16  # At least RADIUS * CHANNELS, and a multiple of all vector lengths

_GAUSS = [math.exp(-(i**2) / (2 * SIGMA**2)) for i in range(-RADIUS, RADIUS + 1)]
TAPS = tuple(float32(value / sum(_GAUSS)) for value in _GAUSS)
C1 = float32(0.01**2)
C2 = float32(0.03**2)
ZERO = float32(0)
ONE = float32(1)
TWO = float32(2)


@inner
def _frame_row(source, divisor, out, start, stride):  # type: ignore[no-untyped-def]
    """Put a row of an image between its margins; uint8 is divided by 255 as torch does."""
    framed = out[start : start + stride]
    framed[:MARGIN] = ZERO
    framed[MARGIN + source.shape[0] :] = ZERO
    inner = framed[MARGIN : MARGIN + source.shape[0]]
    for i in range(source.shape[0]):
        inner[i] = float32(source[i]) / divisor


@inner
def _blur_columns(x, y, start, stride, out):  # type: ignore[no-untyped-def]
    """Vertical part of the four blurs for one row, into four rows of ``out``."""
    for column in range(0, stride, LANES):
        mu = splat(ZERO)
        nu = splat(ZERO)
        squares = splat(ZERO)
        gaps = splat(ZERO)
        for tap in range(2 * RADIUS + 1):
            index = start + (tap - RADIUS) * stride + column
            a = load(x, index)
            b = load(y, index)
            weight = splat(TAPS[tap])
            mu = multiply_add(weight, a, mu)
            nu = multiply_add(weight, b, nu)
            squares = multiply_add(weight, multiply_add(a, a, b * b), squares)
            gaps = multiply_add(weight, (a - b) * (a - b), gaps)
        store(out, column, mu)
        store(out, stride + column, nu)
        store(out, 2 * stride + column, squares)
        store(out, 3 * stride + column, gaps)


@inner
def _blur_at(row, index):  # type: ignore[no-untyped-def]
    total = splat(ZERO)
    for tap in range(2 * RADIUS + 1):
        value = load(row, index + (tap - RADIUS) * CHANNELS)
        total = multiply_add(splat(TAPS[tap]), value, total)
    return total


@inner
def _similarity_row(x, y, start, stride, inside, maps):  # type: ignore[no-untyped-def]
    """Sums of 1 - S and |x - y| over a row; the maps a, b, c of the row go into ``maps``."""
    rows = np.empty(4 * stride, dtype=float32)
    _blur_columns(x, y, start, stride, rows)
    zero = splat(ZERO)
    total = zero
    difference = zero
    plane = maps.shape[0] // 3
    for column in range(MARGIN, stride - MARGIN, LANES):
        mu = _blur_at(rows, column)
        nu = _blur_at(rows, stride + column)
        e = mu - nu
        squares = multiply_add(mu, mu, nu * nu)
        # Rounding must not take a variance below 0, nor var(x - y) above 2 var(x) + 2 var(y).
        variance = _blur_at(rows, 2 * stride + column) - squares
        variance = select(variance < zero, zero, variance)
        v = _blur_at(rows, 3 * stride + column) - e * e
        v = select(v < zero, zero, v)
        v = select(TWO * variance < v, TWO * variance, v)
        mask = load(inside, column)
        over_c = mask / (squares + C1)
        over_d = mask / (variance + C2)
        v_over_d = v * over_d
        ratio = (squares + C1 - e * e) * over_c
        both = ratio * over_d
        index = start + column
        a = e * over_c * (ONE - v_over_d) * (ONE - mu * e * over_c) - both * (e - mu * v_over_d)
        store(maps, index, TWO * mask * a)
        store(maps, plane + index, zero - both * v_over_d)
        store(maps, 2 * plane + index, both)
        total = total + multiply_add(e * e, over_c, ratio * v_over_d)
        gap = load(x, index) - load(y, index)
        difference = difference + select(gap < zero, zero - gap, gap)
    return lane_sum(total), lane_sum(difference)


@inner
def _gradient_row(x, y, maps, start, stride, scales, out):  # type: ignore[no-untyped-def]
    """Gradient of scales[0] * sum|x - y| + scales[1] * sum(1 - S) for one row."""
    plane = maps.shape[0] // 3
    rows = np.empty(3 * stride, dtype=float32)
    for column in range(0, 3 * stride, LANES):
        total = splat(ZERO)
        index = start + column + (column // stride) * (plane - stride)
        for tap in range(2 * RADIUS + 1):
            value = load(maps, index + (tap - RADIUS) * stride)
            total = multiply_add(splat(TAPS[tap]), value, total)
        store(rows, column, total)
    zero = splat(ZERO)
    one = splat(ONE)
    for column in range(0, out.shape[0], LANES):
        framed = MARGIN + column
        a = load(x, start + framed)
        b = load(y, start + framed)
        total = _blur_at(rows, framed)
        total = multiply_add(TWO * a, _blur_at(rows, stride + framed), total)
        total = multiply_add(TWO * (a - b), _blur_at(rows, 2 * stride + framed), total)
        sign = select(b < a, one, select(a < b, zero - one, zero))
        gradient = multiply_add(splat(scales[1]), total, scales[0] * sign)
        store_first(out, column, gradient, out.shape[0] - column)


@kernel(parallel=True)
def l1_ssim(image, target, divisor, scales, gradient):  # type: ignore[no-untyped-def]
    """Sums of |x - y| and 1 - S over all numbers, and the gradient of their weighted sum.

    Args:
        image: float32 [H, 3 W]
        target: uint8 or float32 [H, 3 W]
        divisor: What to divide the target by.
        scales: Weights of the two sums. float32 [2]
        gradient: float32 [H, 3 W], written; [0, 3 W] if none is wanted.
    """
    height, inner = image.shape
    stride = 2 * MARGIN + (inner + LANES - 1) // LANES * LANES
    framed = height + 2 * RADIUS
    x = np.empty(framed * stride, dtype=float32)
    y = np.empty(framed * stride, dtype=float32)
    maps = np.empty(3 * framed * stride, dtype=float32)
    inside = np.zeros(stride, dtype=float32)
    inside[MARGIN : MARGIN + inner] = ONE
    sums = np.empty((height, 2), dtype=float32)
    for row in prange(framed):
        start = row * stride
        written = RADIUS <= row < RADIUS + height
        for plane in range(3):
            # The margins have to be zero; the rest is written before it is read.
            own = maps[plane * framed * stride + start :][:stride]
            if written:
                own[:MARGIN], own[stride - MARGIN :] = ZERO, ZERO
            else:
                own[:] = ZERO
        if written:
            _frame_row(image[row - RADIUS], ONE, x, start, stride)
            _frame_row(target[row - RADIUS], divisor, y, start, stride)
        else:
            x[start : start + stride] = ZERO
            y[start : start + stride] = ZERO
    for row in prange(height):
        start = (row + RADIUS) * stride
        sums[row, 0], sums[row, 1] = _similarity_row(x, y, start, stride, inside, maps)
    for row in prange(gradient.shape[0]):
        start = (row + RADIUS) * stride
        _gradient_row(x, y, maps, start, stride, scales, gradient[row])
    dissimilarity = 0.0
    difference = 0.0
    for row in range(height):
        dissimilarity += sums[row, 0]
        difference += sums[row, 1]
    return difference, dissimilarity
