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
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.fields.mlp import Groups, make_groups
from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices

STOP = 1e-4
"""Transmittance below which nothing more is seen, as in Instant-NGP."""
_LIMIT = 15.0  # Of the exponent that gives a density
_ONE, _ZERO = float32(1), float32(0)
_BLOCK = 64  # Rays per task


def composite_reference(
    densities: Tensor, values: Tensor, lengths: Tensor, groups: Groups, clear: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Sum along rays in plain torch: the definition of `composite`.

    Args:
        clear: Transmittance before the first sample, if not 1. [R]
    """
    depths = densities * lengths
    passed = _passed(depths, groups, clear)
    weights = torch.where(passed >= STOP, passed * (1 - torch.exp(-depths)), 0.0)
    index, rays = groups.of_row.long(), len(groups.starts) - 1
    shape = (rays, values.shape[1])
    sums = values.new_zeros(shape).index_add(0, index, weights[:, None] * values)
    return sums, weights.new_zeros(rays).index_add(0, index, weights)


def _passed(depths: Tensor, groups: Groups, clear: Tensor | None) -> Tensor:
    """Transmittance before each sample. [N]"""
    # The sum runs over all rays, far beyond what float32 can tell apart in one of them.
    every = torch.cumsum(depths.double(), 0) - depths
    starts = groups.starts[:-1].clamp_max(max(len(depths) - 1, 0))
    before = every - every[starts].index_select(0, groups.of_row)
    passed = torch.exp(-before).to(depths)
    return passed if clear is None else passed * clear.index_select(0, groups.of_row)


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
        sums, clear = torch.zeros(rays, channels), torch.ones(rays)
        given = [devices.array_of(t) for t in (densities, values, lengths)]
        starts = groups.starts.numpy()
        _composite_forward(*given, starts, np.arange(rays), sums.numpy(), clear.numpy())
        ctx.kept = *given, starts
        return sums, 1 - clear

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        densities, values, lengths, starts = ctx.kept
        d_densities, d_values = np.zeros_like(densities), np.zeros_like(values)
        given = map(devices.array_of, grads)
        _composite_backward(densities, values, lengths, starts, *given, d_densities, d_values)
        return torch.from_numpy(d_densities), torch.from_numpy(d_values), None, None


@kernel(fast_math=True, parallel=True)
def _composite_forward(densities, values, lengths, starts, rays, sums, transmittance):  # type: ignore[no-untyped-def]
    """Go on with the sums and transmittances of some rays, by the number of each group's ray."""
    groups, channels, stop = len(starts) - 1, values.shape[1], float32(STOP)
    for block in prange((groups + _BLOCK - 1) // _BLOCK):
        for group in range(block * _BLOCK, min(groups, (block + 1) * _BLOCK)):
            ray = rays[group]
            clear = transmittance[ray]
            for i in range(starts[group], starts[group + 1]):
                if clear < stop:
                    break
                after = clear * math.exp(-densities[i] * lengths[i])
                for c in range(channels):
                    sums[ray, c] += (clear - after) * values[i, c]
                clear = after
            transmittance[ray] = clear


@kernel(fast_math=True, parallel=True)
def _composite_backward(  # type: ignore[no-untyped-def]
    densities, values, lengths, starts, grads, d_opacities, d_densities, d_values
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


class Front:
    """Sums along rays so far, from the camera on; nothing of it is differentiated.

    Samples that are added in several parts give the bits of `composite` with all of them.

    Args:
        rays: R
        device: Device of the sums.
    """

    def __init__(self, rays: int, device: str) -> None:
        self.sums = torch.zeros(rays, 0, device=device)
        """[R, C], C as in what was added."""
        self.clear = torch.ones(rays, device=device)
        """Transmittances. [R]"""

    def add(
        self, rays: Tensor, densities: Tensor, values: Tensor, lengths: Tensor, groups: Groups
    ) -> None:
        """Add samples of some rays, by the number of each group's ray; others as `composite`."""
        if self.sums.shape[1] == 0:
            self.sums = values.new_zeros(len(self.clear), values.shape[1])
        if devices.has_kernels(densities, values, lengths):
            given = map(devices.array_of, (densities, values, lengths, groups.starts))
            _composite_forward(*given, rays.numpy(), self.sums.numpy(), self.clear.numpy())
            return
        found = composite_reference(densities, values, lengths, groups, self.clear[rays])
        self.sums[rays] += found[0]
        self.clear[rays] -= found[1]


@torch.no_grad()
def visible(
    densities: Tensor, lengths: Tensor, groups: Groups, clear: Tensor | None = None
) -> Groups:
    """Find the samples that have a weight: the first ones of each ray.

    Args:
        densities: Not negative. [N]
        lengths: Lengths of the samples. [N]
        groups: Samples of each ray, near ones first.
        clear: Transmittance before the first of them, if not 1. [R]

    Returns:
        Groups of them alone.
    """
    if not devices.has_kernels(densities, lengths):
        kept = _passed(densities * lengths, groups, clear) >= STOP
        of_row = groups.of_row.index_select(0, kept.nonzero()[:, 0])
        before = torch.cat((groups.starts[:1], kept.cumsum(0)))
        return Groups(before.index_select(0, groups.starts), of_row)
    clear = densities.new_ones(len(groups.starts) - 1) if clear is None else clear
    given = map(devices.array_of, (densities, lengths, clear))
    starts = groups.starts.numpy()
    counts = np.zeros(len(starts), np.int64)
    _count_visible(*given, starts, counts)
    ends = np.cumsum(counts)
    return groups if ends[-1] == len(densities) else make_groups(torch.from_numpy(ends))


@kernel(fast_math=True, parallel=True)
def _count_visible(densities, lengths, before, starts, counts):  # type: ignore[no-untyped-def]
    rays, stop = len(starts) - 1, float32(STOP)
    for block in prange((rays + _BLOCK - 1) // _BLOCK):
        for ray in range(block * _BLOCK, min(rays, (block + 1) * _BLOCK)):
            clear, end = before[ray], starts[ray]
            while end < starts[ray + 1] and clear >= stop:
                clear *= math.exp(-densities[end] * lengths[end])
                end += 1
            counts[ray + 1] = end - starts[ray]


class _Softplus(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        ctx.x = x.detach()
        if not devices.has_kernels(ctx.x):
            return torch.nn.functional.softplus(ctx.x)
        return torch.from_numpy(np.logaddexp(ctx.x.numpy(), 0, dtype=ctx.x.numpy().dtype))

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        if not devices.has_kernels(ctx.x):
            return grads[0] * ctx.x.sigmoid()
        return grads[0] / (1 + torch.from_numpy(np.exp(-ctx.x.numpy().clip(-80))))


def softplus(x: Tensor) -> Tensor:
    """log(1 + exp x), with equal bits for any number of threads."""
    return _Softplus.apply(x)


def truncated_exp(x: Tensor) -> Tensor:
    """Density of a network's output: exp, cut off above, where its gradient stays finite."""
    return devices.capped_exp(x, _LIMIT)
