"""Sums along rays: what a ray shows of values and densities at its samples.

Source: Max 1995, "Optical Models for Direct Volume Rendering", as in NeRF (Mildenhall et al. 2020,
equation 3).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch
from numba import prange
from numpy import float32
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.fields.mlp import Groups
from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices

STOP = 1e-4
"""Transmittance below which nothing more is seen, as in Instant-NGP."""
_LIMIT = 15.0  # Of the exponent that gives a density; the gradient is cut off beyond
_ONE, _ZERO = float32(1), float32(0)
_BLOCK = 64  # Rays per task


def composite_reference(
    densities: Tensor, values: Tensor, lengths: Tensor, groups: Groups
) -> tuple[Tensor, Tensor]:
    """Sum along rays in plain torch: the definition of `composite`."""
    depths = densities * lengths
    before = torch.cumsum(depths, 0) - depths  # of all rays, so that of the ray's start goes off
    before = before - before[groups.starts[:-1].clamp_max(len(depths) - 1)][groups.of_row.long()]
    clear = torch.exp(-before)
    weights = torch.where(clear >= STOP, clear * (1 - torch.exp(-depths)), 0.0)
    rays = len(groups.starts) - 1
    index = groups.of_row.long()
    shape = (rays, values.shape[1])
    sums = values.new_zeros(shape).index_add(0, index, weights[:, None] * values)
    return sums, weights.new_zeros(rays).index_add(0, index, weights)


def composite(
    densities: Tensor, values: Tensor, lengths: Tensor, groups: Groups
) -> tuple[Tensor, Tensor]:
    """Sum along rays: `composite_reference`, compiled for float32 on a CPU.

    Sample j of a ray, with the density s_j over the length d_j, has the weight
    T_j (1 - exp(-s_j d_j)), where T_j = exp(-sum_{i<j} s_i d_i); none where T_j is below `STOP`.

    Args:
        densities: Not negative. [N]
        values: Colours, or others. [N, C]
        lengths: Lengths of the samples, without a gradient. [N]
        groups: Samples of each ray, near ones first.

    Returns:
        sums: Weighted sums. [R, C]
        opacities: Sums of the weights. [R]
    """
    check_shape("values", values, (len(densities), None))
    check_shape("lengths", lengths, (len(densities),))
    if devices.has_kernels(densities, values, lengths):
        return _Composite.apply(densities, values, lengths, groups)
    return composite_reference(densities, values, lengths, groups)


class _Composite(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, densities: Tensor, values: Tensor, lengths: Tensor, groups: Groups
    ) -> tuple[Tensor, Tensor]:
        rays, channels = len(groups.starts) - 1, values.shape[1]
        sums, opacities = torch.empty(rays, channels), torch.empty(rays)
        given = [t.detach().contiguous().numpy() for t in (densities, values, lengths)]
        starts = groups.starts.numpy()
        _composite_forward(*given, starts, sums.numpy(), opacities.numpy())
        ctx.kept = *given, starts, opacities
        return sums, opacities

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        densities, values, lengths, starts, opacities = ctx.kept
        d_densities, d_values = np.zeros_like(densities), np.zeros_like(values)
        given = [g.contiguous().numpy() for g in grads]
        _composite_backward(
            densities, values, lengths, starts, opacities.numpy(), *given, d_densities, d_values
        )
        return torch.from_numpy(d_densities), torch.from_numpy(d_values), None, None


@kernel(fast_math=True, parallel=True)
def _composite_forward(densities, values, lengths, starts, sums, opacities):  # type: ignore[no-untyped-def]
    rays, channels, stop = len(starts) - 1, values.shape[1], float32(STOP)
    for block in prange((rays + _BLOCK - 1) // _BLOCK):
        for ray in range(block * _BLOCK, min(rays, (block + 1) * _BLOCK)):
            for c in range(channels):
                sums[ray, c] = _ZERO
            clear = _ONE
            for i in range(starts[ray], starts[ray + 1]):
                if clear < stop:
                    break
                after = clear * math.exp(-densities[i] * lengths[i])
                for c in range(channels):
                    sums[ray, c] += (clear - after) * values[i, c]
                clear = after
            opacities[ray] = _ONE - clear


@kernel(fast_math=True, parallel=True)
def _composite_backward(  # type: ignore[no-untyped-def]
    densities, values, lengths, starts, opacities, grads, d_opacities, d_densities, d_values
):
    """Write gradients: dL/ds_j = d_j (T_{j+1} g v_j - sum_{k>j} w_k g v_k + T_end dL/do)."""
    rays, channels, stop = len(starts) - 1, values.shape[1], float32(STOP)
    for block in prange((rays + _BLOCK - 1) // _BLOCK):
        for ray in range(block * _BLOCK, min(rays, (block + 1) * _BLOCK)):
            end, clear, behind = starts[ray], _ONE, _ZERO
            while end < starts[ray + 1] and clear >= stop:
                after = clear * math.exp(-densities[end] * lengths[end])
                shade = _ZERO
                for c in range(channels):
                    shade += grads[ray, c] * values[end, c]
                    d_values[end, c] = (clear - after) * grads[ray, c]
                # For now: what the second pass needs of the first.
                d_densities[end] = after * shade
                clear = after
                end += 1
            rest = clear * d_opacities[ray]
            for i in range(end - 1, starts[ray] - 1, -1):
                shade = _ZERO
                for c in range(channels):
                    shade += d_values[i, c] * values[i, c]
                d_densities[i] = lengths[i] * (d_densities[i] - behind + rest)
                behind += shade


@torch.no_grad()
def visible(densities: Tensor, lengths: Tensor, groups: Groups) -> tuple[Tensor, NDArray[np.int64]]:
    """Find the samples that have a weight: the first ones of each ray.

    Returns:
        seen: Their numbers, ascending. int64 [K]
        starts: First of each ray among them, and the number of all. [R + 1]
    """
    given = [t.detach().cpu().contiguous().numpy() for t in (densities, lengths)]
    starts = groups.starts.cpu().numpy()
    counts = np.zeros(len(starts), np.int64)
    _count_visible(*given, starts, counts)
    ends = np.cumsum(counts)
    first = np.repeat(starts[:-1] - ends[:-1], counts[1:])
    return torch.from_numpy(np.arange(ends[-1]) + first).to(densities.device), ends


@kernel(fast_math=True, parallel=True)
def _count_visible(densities, lengths, starts, counts):  # type: ignore[no-untyped-def]
    rays, stop = len(starts) - 1, float32(STOP)
    for block in prange((rays + _BLOCK - 1) // _BLOCK):
        for ray in range(block * _BLOCK, min(rays, (block + 1) * _BLOCK)):
            clear, end = _ONE, starts[ray]
            while end < starts[ray + 1] and clear >= stop:
                clear *= math.exp(-densities[end] * lengths[end])
                end += 1
            counts[ray + 1] = end - starts[ray]


class _TruncatedExp(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        # NumPy makes one pass, where torch may take another path at the end of a thread's share.
        clipped = x.detach().clamp(max=_LIMIT).contiguous()
        ctx.slope = clipped.exp() if x.is_cuda else torch.from_numpy(np.exp(clipped.numpy()))
        return ctx.slope.clone()

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        return grads[0] * ctx.slope


class _Softplus(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.x = x.detach()
        if x.is_cuda:
            return torch.nn.functional.softplus(ctx.x)
        return torch.from_numpy(np.logaddexp(ctx.x.numpy(), 0, dtype=ctx.x.numpy().dtype))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        if ctx.x.is_cuda:
            return grads[0] * ctx.x.sigmoid()
        return grads[0] / (1 + torch.from_numpy(np.exp(-ctx.x.numpy().clip(-80))))


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp x), with equal bits for any number of threads."""
    return _Softplus.apply(x)


def truncated_exp(x: Tensor) -> Tensor:
    """Density of a network's output: exp, cut off above, where its gradient stays finite."""
    return _TruncatedExp.apply(x)
