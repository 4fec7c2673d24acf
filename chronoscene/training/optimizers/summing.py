"""Gradients of several views of one step, added in the order of the views.

A sum in a fixed order has equal bits for any number of threads.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from numba import prange
from torch import Tensor

from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices
from chronoscene.training.optimizers.adam import DenseTable
from chronoscene.training.optimizers.row_adam import RowAdam

Part = tuple[Tensor, Tensor]
"""Rows of a table that a view has read, each once, and the copies of them that have its gradient.
int64 [M], [M, ...]"""


def add_gradients(total: dict[str, Tensor], found: Mapping[str, Tensor]) -> None:
    """Add the gradients of a view to those of the views before; the first ones are taken over."""
    for name, gradient in found.items():
        if name in total:
            total[name] += gradient
        else:
            total[name] = gradient


@torch.no_grad()
def use_sum(table: DenseTable | RowAdam, parts: Sequence[Part]) -> None:
    """Let the next step of a table use the sum of the gradients of some views.

    Args:
        table: Has not been stepped since the views have read it.
        parts: What each view has read of it, at least one.
    """
    if len(parts) == 1:
        table.fetched = parts[0]
        return
    seen = torch.zeros(len(table.value), dtype=torch.bool, device=table.value.device)
    for rows, _ in parts:
        seen[rows] = True
    copies = table.fetch(seen.nonzero()[:, 0])
    total, places = torch.zeros_like(copies), seen.cumsum(0) - 1
    for rows, read in parts:
        if read.grad is not None:
            _add_to_rows(total, places[rows], read.grad)
    copies.grad = total


def _add_to_rows(total: Tensor, rows: Tensor, added: Tensor) -> None:
    """Add to some rows, each named once. [R, ...], int64 [M], [M, ...]"""
    if devices.has_kernels(total, added):
        flat = (
            tensor.reshape(len(tensor), math.prod(total.shape[1:])) for tensor in (total, added)
        )
        _add_rows(*(tensor.numpy() for tensor in flat), rows.numpy())
    else:
        total[rows] += added


@kernel(parallel=True)
def _add_rows(total, added, rows):  # type: ignore[no-untyped-def]
    for m in prange(len(rows)):
        row = rows[m]
        for c in range(total.shape[1]):
            total[row, c] += added[m, c]
