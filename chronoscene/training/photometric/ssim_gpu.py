"""The loss of `ssim_kernel` and its gradient as kernels for a GPU.

The maps and their names are those of `ssim_kernel`; images are rows of 3 W interleaved numbers
there and here. Each blur is a pass along the rows and one along the columns, which goes on with
what follows: nothing but the maps themselves is written.
"""

from __future__ import annotations

import torch
import triton
import triton.language as tl
from torch import Tensor

from chronoscene.training.photometric.ssim_kernel import C1, C2, CHANNELS, RADIUS, TAPS

BLOCK = 512
_C1, _C2, _RADIUS, _CHANNELS = (tl.constexpr(x) for x in (float(C1), float(C2), RADIUS, CHANNELS))
_G0, _G1, _G2, _G3, _G4, _G5 = (tl.constexpr(float(tap)) for tap in TAPS[RADIUS:])


def l1_ssim(image: Tensor, target: Tensor, weights: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Weighted sum of the sums of |x - y| and 1 - S over all numbers, and its gradient in x.

    Args:
        image: x. float32 [H, W, 3]
        target: y. uint8 0..255, or float32 [H, W, 3]
        weights: Of the two sums.

    Returns:
        value: A scalar.
        gradient: [H, W, 3]
    """
    image, target = image.contiguous(), target.contiguous()
    height, width = image.shape[0], image.shape[1] * CHANNELS
    grid = (triton.cdiv(width, BLOCK), height)
    blurred, slopes = image.new_empty(4, height, width), image.new_empty(3, height, width)
    gradient, sums = torch.empty_like(image), image.new_empty(height, grid[0])
    unit = 1 / 255 if target.dtype == torch.uint8 else 1.0
    plane = height * width
    _blur_rows_of_images[grid](image, target, unit, blurred, plane, width, BLOCK=BLOCK)
    _compare[grid](blurred, slopes, sums, plane, width, weights[1], BLOCK=BLOCK)
    _blur_rows_of_slopes[grid](slopes, blurred, plane, width, BLOCK=BLOCK)
    total = sums.sum()
    _differentiate[grid](
        image, target, unit, blurred, gradient, sums, plane, width, *weights, BLOCK=BLOCK
    )
    return total + sums.sum(), gradient


@triton.jit
def _tap(i: tl.constexpr):  # type: ignore[no-untyped-def]
    """Weight of a neighbour at a distance -5 .. 5."""
    distance: tl.constexpr = i if i > 0 else -i
    near: tl.constexpr = _G0 if distance == 0 else (_G1 if distance == 1 else _G2)
    far: tl.constexpr = _G3 if distance == 3 else (_G4 if distance == 4 else _G5)
    return near if distance < 3 else far


@triton.jit
def _along_row(maps, row, column, width, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Blur a map along a row."""
    total = tl.zeros([BLOCK], tl.float32)
    for i in tl.static_range(-_RADIUS, _RADIUS + 1):
        at = column + i * _CHANNELS
        inside = (at >= 0) & (at < width)
        total += _tap(i) * tl.load(maps + row * width + at, mask=inside, other=0.0)
    return total


@triton.jit
def _along_columns(maps, row, column, plane, width, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Blur a map along its columns."""
    total = tl.zeros([BLOCK], tl.float32)
    for i in tl.static_range(-_RADIUS, _RADIUS + 1):
        at = (row + i) * width + column
        inside = (column < width) & (at >= 0) & (at < plane)
        total += _tap(i) * tl.load(maps + at, mask=inside, other=0.0)
    return total


@triton.jit
def _blur_rows_of_images(x, y, unit, out, plane, width, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Blur x, y, x² + y² and (x - y)² along the rows. [H, 3 W] -> [4, H, 3 W]"""
    row = tl.program_id(1).to(tl.int64)
    column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    one = tl.zeros([BLOCK], tl.float32)
    two, squares, gaps = one, one, one
    for i in tl.static_range(-_RADIUS, _RADIUS + 1):
        at = column + i * _CHANNELS
        inside = (at >= 0) & (at < width)
        a = tl.load(x + row * width + at, mask=inside, other=0.0)
        b = tl.load(y + row * width + at, mask=inside, other=0).to(tl.float32) * unit
        tap = _tap(i)
        one += tap * a
        two += tap * b
        squares += tap * (a * a + b * b)
        gaps += tap * (a - b) * (a - b)
    there, inside = out + row * width + column, column < width
    tl.store(there, one, mask=inside)
    tl.store(there + plane, two, mask=inside)
    tl.store(there + plane + plane, squares, mask=inside)
    tl.store(there + plane + plane + plane, gaps, mask=inside)


@triton.jit
def _compare(maps, out, sums, plane, width, weight, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Blur four maps along the columns; write what `_differentiate` blurs, and sums of 1 - S."""
    row = tl.program_id(1).to(tl.int64)
    column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = column < width
    mu = _along_columns(maps, row, column, plane, width, BLOCK)
    nu = _along_columns(maps + plane, row, column, plane, width, BLOCK)
    squares = _along_columns(maps + plane + plane, row, column, plane, width, BLOCK)
    gaps = _along_columns(maps + plane + plane + plane, row, column, plane, width, BLOCK)
    e = mu - nu
    both_squares = mu * mu + nu * nu
    # Rounding must not take a variance below 0, nor var(x - y) above 2 var(x) + 2 var(y).
    variance = tl.maximum(squares - both_squares, 0.0)
    v = tl.minimum(tl.maximum(gaps - e * e, 0.0), 2 * variance)
    over_c, over_d = 1 / (both_squares + _C1), 1 / (variance + _C2)
    v_over_d = v * over_d
    ratio = (both_squares + _C1 - e * e) * over_c
    both = ratio * over_d
    a = e * over_c * (1 - v_over_d) * (1 - mu * e * over_c) - both * (e - mu * v_over_d)
    there = out + row * width + column
    tl.store(there, 2 * a, mask=inside)
    tl.store(there + plane, -both * v_over_d, mask=inside)
    tl.store(there + plane + plane, both, mask=inside)
    dissimilarity = tl.where(inside, e * e * over_c + ratio * v_over_d, 0.0)
    tl.store(sums + row * tl.num_programs(0) + tl.program_id(0), weight * tl.sum(dissimilarity))


@triton.jit
def _blur_rows_of_slopes(maps, out, plane, width, BLOCK: tl.constexpr):  # type: ignore[no-untyped-def]
    """Blur three maps along the rows. [3, H, 3 W]"""
    row = tl.program_id(1).to(tl.int64)
    column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    there = out + row * width + column
    for _ in tl.static_range(3):
        tl.store(there, _along_row(maps, row, column, width, BLOCK), mask=column < width)
        maps, there = maps + plane, there + plane


@triton.jit
def _differentiate(  # type: ignore[no-untyped-def]
    x, y, unit, maps, out, sums, plane, width, weight, other_weight, BLOCK: tl.constexpr
):
    """Blur three maps along the columns; write the gradient, and sums of |x - y|."""
    row = tl.program_id(1).to(tl.int64)
    column = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    inside = column < width
    one = _along_columns(maps, row, column, plane, width, BLOCK)
    two = _along_columns(maps + plane, row, column, plane, width, BLOCK)
    three = _along_columns(maps + plane + plane, row, column, plane, width, BLOCK)
    at = row * width + column
    a = tl.load(x + at, mask=inside, other=0.0)
    b = tl.load(y + at, mask=inside, other=0).to(tl.float32) * unit
    gap = a - b
    sign = tl.where(gap > 0, 1.0, tl.where(gap < 0, -1.0, 0.0))
    slope = one + 2 * a * two + 2 * gap * three
    tl.store(out + at, weight * sign + other_weight * slope, mask=inside)
    difference = tl.where(inside, tl.abs(gap), 0.0)
    tl.store(sums + row * tl.num_programs(0) + tl.program_id(0), weight * tl.sum(difference))
