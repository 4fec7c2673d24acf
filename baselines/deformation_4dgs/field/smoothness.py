"""Terms of the loss that keep the planes of a field smooth, and those with time near one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy import float32
from torch import Tensor

from baselines.deformation_4dgs.field.layout import Field
from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices


class Weights(NamedTuple):
    """Weights of the three terms."""

    space: float
    """Second differences along the rows of planes xy, xz and yz."""
    time: float
    """Second differences along the rows, which are times, of planes xt, yt and zt."""
    ones: float
    """Distance of planes xt, yt and zt from one."""

    def of(self, name: str) -> tuple[float, float]:
        """Weights of second differences and of the distance from one in a plane."""
        return (self.time, self.ones) if name.endswith("t") else (self.space, 0.0)


def smoothness(tensors: Mapping[str, Tensor], field: Field, weights: Weights) -> Tensor:
    """`smoothness_reference`, compiled for float32 on a CPU."""
    names = [name for name in field.shapes() if name.startswith("planes.")]
    planes = [tensors[name] for name in names]
    if not devices.has_kernels(*planes):
        return smoothness_reference(tensors, field, weights)
    return _Smoothness.apply([weights.of(name) for name in names], *planes)


def smoothness_reference(tensors: Mapping[str, Tensor], field: Field, weights: Weights) -> Tensor:
    """Sum over planes P of w mean (P[r - 1] - 2 P[r] + P[r + 1])^2 + v mean |1 - P|.

    Planes with fewer than three rows have no second differences.

    Returns:
        A scalar.

    Source: the released code, which calls the first a total variation in space. Only differences
    along the rows count, so of the two axes of a spatial plane only the second.
    """
    total = torch.zeros((), dtype=torch.float64, device=tensors["trunk.bias"].device)
    for name in field.shapes():
        if not name.startswith("planes."):
            continue
        plane, (rough, one) = tensors[name], weights.of(name)
        if len(plane) > 2:
            total = total + rough * (plane[:-2] - 2 * plane[1:-1] + plane[2:]).square().mean()
        total = total + one * (1 - plane).abs().mean()
    return total.to(tensors["trunk.bias"])


class _Smoothness(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, weights: list[tuple[float, float]], *planes: Tensor) -> Tensor:
        ctx.grads = [torch.zeros_like(plane) for plane in planes]
        total = 0.0
        for plane, grad, (rough, one) in zip(planes, ctx.grads, weights, strict=True):
            rows, grads = (t.detach().view(len(plane), -1).numpy() for t in (plane, grad))
            total += _add_roughness(rows, rough / max(rows[2:].size, 1), one / rows.size, grads)
        return torch.tensor(total, dtype=torch.float32)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        return None, *(grads[0] * grad for grad in ctx.grads)


@kernel
def _add_roughness(rows, rough, one, grads):  # type: ignore[no-untyped-def]
    """Terms of a plane given as a matrix; adds its gradient to ``grads``.

    Args:
        rough: Weight of each squared second difference.
        one: Weight of each distance from one.
    """
    total, count = 0.0, rows.shape[1]
    factor = float32(2 * rough)
    for r in range(1, rows.shape[0] - 1):
        squares = 0.0
        for c in range(count):
            difference = rows[r - 1, c] - float32(2) * rows[r, c] + rows[r + 1, c]
            squares += difference * difference
            grads[r - 1, c] += factor * difference
            grads[r, c] -= float32(2) * factor * difference
            grads[r + 1, c] += factor * difference
        total += rough * squares
    if one > 0:
        for r in range(rows.shape[0]):
            for c in range(count):
                total += one * abs(float32(1) - rows[r, c])
                grads[r, c] += float32(one) * np.sign(rows[r, c] - float32(1))
    return total
