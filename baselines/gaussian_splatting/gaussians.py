"""The parameters of a scene of Gaussians, and what they mean."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from chronoscene.errors import SceneError
from chronoscene.gaussians.spherical_harmonics import NUM_BASES, dc_from_rgb
from chronoscene.methods import TrainingSet

SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logit_opacities": (),
    "sh_dc": (3,),
    "sh_rest": (NUM_BASES - 1, 3),
}
"""Parameter groups: name to the shape of one row."""

SMALLEST_SQUARED_SPACING = 1e-7
"""Points nearer to each other than its root, in training units, start no smaller than it."""
NEIGHBOURS = 3


def initialise(train: TrainingSet, *, opacity: float) -> dict[str, Tensor]:
    """One round Gaussian per sparse point, as large as the points around it are far.

    Returns:
        parameters: float32 on the CPU, as `SHAPES` says.

    Raises:
        SceneError: If the scene has no sparse points.
    """
    finite = np.isfinite(train.points).all(-1)
    points, colors = train.points[finite], train.colors[finite]
    count = len(points)
    if count == 0:
        raise SceneError(
            "points3D",
            expected="finite sparse points to start the Gaussians from",
            found="none",
            todo="triangulate points for this scene",
        )
    spacing = np.sqrt(np.maximum(mean_squared_spacing(points), SMALLEST_SQUARED_SPACING))
    log_scales = torch.from_numpy(np.log(spacing).astype(np.float32))
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return {
        "means": torch.from_numpy(points.astype(np.float32)),
        "log_scales": log_scales[:, None].repeat(1, 3),
        "quats": quats,
        "logit_opacities": torch.full((count,), logit(opacity)),
        "sh_dc": dc_from_rgb(torch.from_numpy(colors.astype(np.float32)) / 255),
        "sh_rest": torch.zeros(count, NUM_BASES - 1, 3),
    }


def mean_squared_spacing(points: np.ndarray) -> np.ndarray:
    """Mean squared distance of each point to its three nearest others. [P, 3] -> float64 [P]

    With fewer others than three, to those that there are; 0 for a lone point.
    """
    neighbours = min(NEIGHBOURS, len(points) - 1)
    if neighbours == 0:
        return np.zeros(len(points))
    xyz = points.astype(np.float64)
    distances, _ = cKDTree(xyz).query(xyz, k=neighbours + 1)
    # The first neighbour is the point itself, or a twin at distance 0, which is the same.
    return np.mean(distances[:, 1:] ** 2, axis=1)


def logit(probability: float) -> float:
    return float(np.log(probability / (1 - probability)))


class _Exp(torch.autograd.Function):
    """``torch.exp`` whose bits do not depend on how its rows are shared among threads."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = _exp(x.detach())
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return grads[0] * y


class _Sigmoid(torch.autograd.Function):
    """``torch.sigmoid`` with the same care."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = 1 / (1 + _exp(-x.detach()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return grads[0] * (1 - y) * y


def _exp(x: Tensor) -> Tensor:
    # Torch may take another code path at the end of each thread's share of the rows; NumPy makes
    # one pass. Products and quotients of float32 are exact to the bit wherever they are done.
    if x.is_cuda:
        return x.exp()
    with np.errstate(over="ignore"):
        return torch.from_numpy(np.exp(x.contiguous().numpy()))


def scales_of(log_scales: Tensor) -> Tensor:
    """Standard deviations in units of the training frame. [N, 3]"""
    result: Tensor = _Exp.apply(log_scales)
    return result


def opacities_of(logit_opacities: Tensor) -> Tensor:
    """Opacities 0..1. [N]"""
    result: Tensor = _Sigmoid.apply(logit_opacities)
    return result
