"""The parameters of a scene of Gaussians, what they mean, and where they start."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import Any

import numpy as np
import torch
from torch import Tensor

from chronoscene.methods import TrainingSet, View
from chronoscene.training.devices import capped_exp, exp
from chronoscene.training.drawing import Splats, camera_centre_tensor
from chronoscene.training.points import finite_rows, rms_spacing
from chronoscene.training.spherical_harmonics import NUM_BASES, dc_from_rgb, evaluate

SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logit_opacities": (),
    "sh_dc": (3,),
    "sh_rest": (NUM_BASES - 1, 3),
}
"""Groups of parameters: name to the shape of one row."""

_MAX_EXPONENT = 88.0
"""Logarithm of the largest scale. An infinite one would turn the gradient of a Gaussian that is not
drawn, 0, into nan, and with it that of the whole step."""
MIN_SPACING = math.sqrt(1e-7)
"""Smallest initial scale, in training units, however close the points are."""


@dataclass(eq=False)
class GaussianModel:
    """Gaussians and what a method trains beside them."""

    parameters: dict[str, Tensor]
    """Groups with a row per Gaussian; density control adds and removes rows. A method may have
    more groups than `SHAPES`. [N, ...]"""
    shared: dict[str, Tensor] = field(default_factory=dict)
    """Trained tensors without a row per Gaussian, such as those of a deformation field."""
    _: KW_ONLY
    sh_degree: int = 0
    """Degree of the spherical harmonics in use."""
    is_final: bool = False
    """True once nothing changes any more: the Gaussians of the latest period are then kept for the
    next view."""
    _latest: tuple[float, Mapping[str, Tensor]] | None = field(default=None, init=False)

    def __len__(self) -> int:
        return len(self.parameters["means"])

    def tensors(self) -> dict[str, Tensor]:
        """Everything that is trained and stored, by name."""
        return self.parameters | self.shared

    def at_period(self, period: float) -> Mapping[str, Tensor]:
        """The parameters as of a period, before the activations; here always the same.

        A method with a deformation field overrides this: what it returns is drawn, and gradients
        flow through it to `parameters`, which density control works on, and to `shared`.
        """
        return self.parameters

    def splats(self, view: View, period: float) -> Splats:
        """The Gaussians to draw in a view as of a period."""
        p = self._drawn_at(period)
        centre = camera_centre_tensor(view, p["means"].device)
        return Splats(
            means=p["means"],
            quats=p["quats"],
            scales=scales_of(p["log_scales"]),
            opacities=opacities_of(p["logit_opacities"]),
            colors=evaluate(p["sh_dc"], p["sh_rest"], p["means"], centre, self.sh_degree),
        )

    def _drawn_at(self, period: float) -> Mapping[str, Tensor]:
        """`at_period`, computed once for consecutive views of a period if the model is final."""
        if not self.is_final:
            return self.at_period(period)
        if self._latest is None or self._latest[0] != period:
            self._latest = None  # Frees its memory first
            self._latest = period, self.at_period(period)
        return self._latest[1]


def initialise(train: TrainingSet, *, opacity: float, scale: float = 1.0) -> dict[str, Tensor]:
    """One round Gaussian per sparse point, as large as the points around it are far.

    The scale is a multiple of the root mean square distance to the three nearest points.

    Returns:
        parameters: float32 on the CPU, as `SHAPES` says.

    Raises:
        SceneError: If the scene has no sparse points.

    Source: Kerbl et al. 2023, and the released code.
    """
    rows = finite_rows(train.points)
    points, colors = train.points[rows], train.colors[rows]
    count = len(points)
    scales = scale * np.maximum(rms_spacing(points), MIN_SPACING)
    quats = torch.zeros(count, 4)
    quats[:, 0] = 1.0
    return {
        "means": torch.from_numpy(points.astype(np.float32)),
        "log_scales": torch.from_numpy(np.log(scales).astype(np.float32))[:, None].repeat(1, 3),
        "quats": quats,
        "logit_opacities": torch.full((count,), logit(opacity)),
        "sh_dc": dc_from_rgb(torch.from_numpy(colors.astype(np.float32)) / 255),
        "sh_rest": torch.zeros(count, NUM_BASES - 1, 3),
    }


def logit(probability: float) -> float:
    """Inverse of the sigmoid."""
    return float(np.log(probability / (1 - probability)))


class _Sigmoid(torch.autograd.Function):
    """``torch.sigmoid`` whose bits do not depend on how its rows are shared among threads."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        # Products and quotients of float32 are exact to the bit wherever they are done.
        y = 1 / (1 + exp(-x.detach()))
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return grads[0] * (1 - y) * y


def scales_of(log_scales: Tensor) -> Tensor:
    """Standard deviations in units of the training frame, finite where logarithms are. [N, 3]"""
    return capped_exp(log_scales, _MAX_EXPONENT)


def opacities_of(logit_opacities: Tensor) -> Tensor:
    """Opacities 0..1. [N]"""
    return _Sigmoid.apply(logit_opacities)


def axes_of(quats: Tensor) -> tuple[tuple[Tensor, Tensor, Tensor], ...]:
    """The axes x, y, z of Gaussians, each as three coordinates of [N]. [N, 4]

    The columns of a rotation; not finite for a quaternion of length zero. Sums are written out, so
    that bits do not depend on how a product shares its work.
    """
    parts = quats.unbind(-1)
    length = dot(parts, parts).sqrt()
    w, x, y, z = (part / length for part in parts)
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)),
        (2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)),
        (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)),
    )


def dot(left: Sequence[Tensor], right: Sequence[Tensor]) -> Tensor:
    """Sum of products, from the first on."""
    total = left[0] * right[0]
    for a, b in zip(left[1:], right[1:], strict=True):
        total = total + a * b
    return total
