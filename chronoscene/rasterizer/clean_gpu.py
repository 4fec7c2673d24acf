"""Gaussians without what no rasterizer can draw: a kernel for a GPU."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

BLOCK = 256


def cleaned(
    gaussians: Sequence[Tensor], *, least_length: float, least_opacity: float
) -> tuple[list[Tensor], Tensor]:
    """Make Gaussians with a bad row invisible and harmless; see `gsplat_backend`.

    Args:
        gaussians: Means, quats, scales, opacities, colors. float32
        least_length: Of the largest number of a quaternion.
        least_opacity: Gaussians must be above it.

    Returns:
        gaussians: Alike.
        good: bool [N]
    """
    *made, good = _Clean.apply(least_length, least_opacity, *gaussians)
    return made, good


class _Clean(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, length: float, opacity: float, *gaussians: Tensor) -> tuple[Tensor, ...]:
        arrays = [array.contiguous() for array in gaussians]
        made, count = [torch.empty_like(array) for array in arrays], len(arrays[0])
        good = torch.empty(count, dtype=torch.bool, device=arrays[0].device)
        _clean[(triton.cdiv(count, BLOCK),)](
            *arrays, *made, good, count, length, opacity, D=arrays[4].shape[1], BLOCK=BLOCK
        )
        ctx.mark_non_differentiable(good)
        return (*made, good)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        # What was replaced is not drawn, and has the gradient zero already.
        return None, None, *grads[:5]


@triton.jit
def _clean(  # type: ignore[no-untyped-def]
    means, quats, scales, opacities, colors,
    to_means, to_quats, to_scales, to_opacities, to_colors, good,
    count, length, opacity, D: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    i = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = i < count
    alpha = tl.load(opacities + i, mask=inside, other=0.0)
    fine = (alpha > opacity) & (alpha < float("inf"))
    largest = tl.zeros([BLOCK], tl.float32)
    for c in tl.static_range(3):
        fine = fine & _finite(tl.load(means + 3 * i + c, mask=inside, other=0.0))
        fine = fine & _finite(tl.load(scales + 3 * i + c, mask=inside, other=0.0))
    for c in tl.static_range(4):
        q = tl.load(quats + 4 * i + c, mask=inside, other=0.0)
        fine = fine & _finite(q)
        largest = tl.maximum(largest, tl.abs(q))
    for c in tl.static_range(D):
        fine = fine & _finite(tl.load(colors + D * i + c, mask=inside, other=0.0))
    fine = fine & (largest >= length)
    tl.store(good + i, fine, mask=inside)
    tl.store(to_opacities + i, tl.where(fine, alpha, 0.0), mask=inside)
    for c in tl.static_range(3):
        mean = tl.load(means + 3 * i + c, mask=inside, other=0.0)
        tl.store(to_means + 3 * i + c, tl.where(fine, mean, 0.0), mask=inside)
        scale = tl.load(scales + 3 * i + c, mask=inside, other=0.0)
        tl.store(to_scales + 3 * i + c, tl.where(fine, scale, 1.0), mask=inside)
    for c in tl.static_range(4):
        unit = 1.0 if c == 0 else 0.0
        q = tl.load(quats + 4 * i + c, mask=inside, other=0.0)
        tl.store(to_quats + 4 * i + c, tl.where(fine, q, unit), mask=inside)
    for c in tl.static_range(D):
        color = tl.load(colors + D * i + c, mask=inside, other=0.0)
        tl.store(to_colors + D * i + c, tl.where(fine, color, 0.0), mask=inside)


@triton.jit
def _finite(x):  # type: ignore[no-untyped-def]
    return tl.abs(x) < float("inf")  # False for nan
