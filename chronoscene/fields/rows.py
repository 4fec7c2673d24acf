"""Parts of groups of rows: some consecutive rows of each, one after the other."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.fields.mlp import Groups
from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices

_BLOCK = 64  # Groups per task


def part_rows(x: Tensor, first: Tensor, groups: Groups) -> Tensor:
    """Return some rows of each group, compiled for float32 on a CPU.

    Args:
        x: Rows. [N, ...]
        first: First row that is taken of each group; no row is taken twice. int64 [R]
        groups: Groups of the result.
    """
    if devices.has_kernels(x):
        return _PartRows.apply(x, first.numpy(), groups.starts.numpy())
    moved = (first - groups.starts[:-1]).index_select(0, groups.of_row)
    return x.index_select(0, moved + torch.arange(len(moved), device=x.device))


class _PartRows(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, first: NDArray[np.int64], starts: NDArray[np.int64]) -> Tensor:
        ctx.kept = x.shape, first, starts
        out, width = x.new_empty(int(starts[-1]), *x.shape[1:]), x[:1].numel()
        _copy(devices.flat(x), first, devices.flat(out), starts[:-1], np.diff(starts), width)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        shape, first, starts = ctx.kept
        out = grads[0].new_zeros(shape)
        width = out[:1].numel()
        _copy(devices.flat(grads[0]), starts[:-1], devices.flat(out), first, np.diff(starts), width)
        return out, None, None


@kernel(parallel=True)
def _copy(source, source_first, target, target_first, counts, width):  # type: ignore[no-untyped-def]
    """Copy counts[r] rows from one place to another, for each group r."""
    groups = len(counts)
    for block in prange((groups + _BLOCK - 1) // _BLOCK):
        for group in range(block * _BLOCK, min(groups, (block + 1) * _BLOCK)):
            a, b = source_first[group] * width, target_first[group] * width
            size = counts[group] * width
            target[b : b + size] = source[a : a + size]
