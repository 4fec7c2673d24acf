"""Multiresolution hash grid: a code of a place, interpolated from learned features.

Source: Müller et al. 2022, "Instant Neural Graphics Primitives with a Multiresolution Hash
Encoding", section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.fields.grid_kernels import encode_backward, encode_forward
from chronoscene.kernels.vectors import LANES
from chronoscene.training import devices

FEATURES = 2
"""Features of a row of the table."""
_PRIMES = (1, 2654435761, 805459861)
_START = 1e-4  # Features start uniform within plus and minus this


@dataclass(frozen=True)
class GridLayout:
    """Levels of a grid over the unit cube, whose cells become smaller by a constant factor."""

    levels: int
    """L"""
    log2_rows: int
    """Logarithm of the largest number of rows of a level; those that need no more are dense."""
    base: int
    """Cells along an edge on the first level."""
    finest: int
    """Cells along an edge on the last level."""

    @property
    def width(self) -> int:
        """Numbers of a code."""
        return FEATURES * self.levels

    @cached_property
    def resolutions(self) -> NDArray[np.int64]:
        """Cells along an edge. [L]"""
        growth = (self.finest / self.base) ** (1 / max(self.levels - 1, 1))
        return np.floor(self.base * growth ** np.arange(self.levels) + 1e-6).astype(np.int64)

    @cached_property
    def dense(self) -> NDArray[np.bool_]:
        """Levels on which each grid point has a row of its own. [L]"""
        return (self.resolutions + 1) ** 3 <= 1 << self.log2_rows

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """First row of each level, and the number of all rows. [L + 1]"""
        sizes = np.minimum((self.resolutions + 1) ** 3, 1 << self.log2_rows)
        return np.concatenate(([0], np.cumsum(sizes)))

    def initial_table(self, generator: torch.Generator) -> Tensor:
        """Draw the features that a training starts with. [E, 2]"""
        shape = (int(self.starts[-1]), FEATURES)
        return (2 * torch.rand(shape, generator=generator) - 1) * _START


def encode_reference(places: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Interpolate the code of each place in plain torch: the definition of `encode`.

    On a level with R cells along an edge, a place x lies in the cell floor(R x); the features of
    its eight corners are mixed trilinearly. Corner (i, j, k) has the row
    i + (R + 1) (j + (R + 1) k) on a dense level, else (i xor 2654435761 j xor 805459861 k) mod the
    rows of the level.
    """
    rows, weights = [], []
    for level, cells in enumerate(layout.resolutions.tolist()):
        start, end = layout.starts[level : level + 2].tolist()
        scaled = places * cells
        lower = scaled.detach().floor()
        share = scaled - lower
        # Of both sides of the cell along each axis, then of the 2 x 2 x 2 corners. [2, N] each
        x, y, z = torch.stack((lower, lower + 1)).long().unbind(2)
        wx, wy, wz = torch.stack((1 - share, share)).unbind(2)
        y, z = y[:, None], z[:, None, None]
        if layout.dense[level]:
            row = x + (cells + 1) * (y + (cells + 1) * z)
        else:
            row = (x ^ y * _PRIMES[1] ^ z * _PRIMES[2]) % (end - start)
        rows.append(start + row)
        weights.append(wx * wy[:, None] * wz[:, None, None])
    # Once for all rows: the gradient of each such call is as large as the table.
    features = table.index_select(0, torch.stack(rows).flatten())
    corners = torch.stack(weights).view(layout.levels, 8, -1, 1)
    mixed = (corners * features.view(layout.levels, 8, -1, FEATURES)).sum(1)
    return mixed.transpose(0, 1).flatten(1)


class _Encode(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, table: Tensor, places: Tensor, layout: GridLayout) -> Tensor:
        out = torch.empty(len(places), layout.width)
        levels = layout.resolutions, layout.starts, layout.dense
        given = _padded(places.numpy()), len(places)
        threads = numba.get_num_threads()
        encode_forward(*given, devices.flat(table), *levels, threads, devices.flat(out))
        ctx.given, ctx.levels = given, levels
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        out = torch.zeros(int(ctx.levels[1][-1]), FEATURES)
        given = devices.flat(grads[0])
        by_level = np.empty(len(given) + 2 * LANES, np.float32)
        by_level[len(given) :] = 0  # read beside the last gradients, where a nan would hide them
        rest = numba.get_num_threads(), by_level, devices.flat(out)
        encode_backward(*ctx.given, given, *ctx.levels, *rest)
        return out, None, None


def _padded(places: NDArray[np.float32]) -> NDArray[np.float32]:
    """Flat places with zeros up to a multiple of LANES rows."""
    return np.append(places, np.zeros((-len(places) % LANES, 3), np.float32))


def encode(places: Tensor, table: Tensor, layout: GridLayout) -> Tensor:
    """Interpolate the code of each place: `encode_reference`, compiled for float32 on a CPU.

    Args:
        places: In the unit cube, below 1; get no gradient. [N, 3]
        table: Features of all levels. [E, 2]
        layout: Levels.

    Returns:
        Codes, level by level. [N, 2 L]
    """
    check_shape("places", places, (None, 3))
    check_shape("table", table, (int(layout.starts[-1]), FEATURES))
    if devices.has_kernels(places, table):
        return _Encode.apply(table, places.contiguous(), layout)
    return encode_reference(places, table, layout)
