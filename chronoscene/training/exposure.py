"""Exposure compensation: an affine transform of colours per training image, or per period.

A photo may be brighter or warmer than its neighbours. The rendered image is transformed before it
is compared with the photo, so that the model need not explain the difference. Transforms start as
the identity and are learned with the model. Test images are never fitted: a view to render has the
transform of its period, which is the mean over the period's training images where each image has
its own.

Source: the exposure option of the 2024 release of 3D Gaussian Splatting, whose rule for test
images differs (the identity, or a fit to half of each).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.kernels.compilation import kernel
from chronoscene.methods import TrainingSet
from chronoscene.training import devices
from chronoscene.training.optimizers.adam import ONE_VIEW, DenseTable, Pace
from chronoscene.training.optimizers.summing import Part, use_sum
from chronoscene.training.periods import period_weights
from chronoscene.training.schedules import log_linear
from chronoscene.training.spherical_harmonics import C0

ExposureKind = Literal["none", "image", "period"]
"""``none``: no transforms; else what has one of its own."""

LEARNING_RATE = (0.01, 0.001)
"""Learning rate of Adam at the start and at the end; log-linear between."""


class Exposure:
    """Transforms of colours that a training learns.

    Args:
        kind: Owner of each transform.
        train: Training views.
        device: Device of the tensors.
        pace: By how many views the gradients of a step are.
    """

    def __init__(
        self, kind: str, train: TrainingSet, device: str | torch.device, pace: Pace = ONE_VIEW
    ) -> None:
        self._pace = pace
        periods = np.array([view.period for view in train.views])
        self._kind, self._periods = kind, torch.from_numpy(periods).to(device)
        own = torch.arange(len(train.views), device=device)
        self._rows = own if kind == "image" else self._periods
        self.begin(torch.eye(3, 4, device=device).repeat(train.num_periods, 1, 1))

    def begin(self, by_period: Tensor) -> None:
        """Start anew from other transforms than the identity.

        Args:
            by_period: Those of all periods. [T, 3, 4]
        """
        self._start = by_period
        starts = by_period[self._periods] if self._kind == "image" else by_period.clone()
        self.tables = [] if self._kind == "none" else [DenseTable(starts, self._pace)]
        """The transforms, a row for each; no table with kind ``none``. [R, 3, 4]"""

    def apply(self, image: Tensor, number: int) -> Tensor:
        """Return the image as view ``number`` would show it. [H, W, 3]"""
        for table in self.tables:
            image = transformed(image, table.fetch(self._rows[number : number + 1])[0])
        return image

    def gradients(self) -> dict[str, Tensor]:
        """Return the gradient of the transforms, if there is one."""
        gradient = self.tables[0].gradient() if self.tables else None
        return {} if gradient is None else {"exposure": gradient}

    def parts(self) -> list[Part]:
        """Return what `apply` has read of each table, for `use`."""
        return [table.fetched for table in self.tables if table.fetched is not None]

    def use(self, views: Sequence[Sequence[Part]]) -> None:
        """Let `step` use the sum of the gradients of some views: what `parts` gave after each."""
        for table, parts in zip(self.tables, zip(*views, strict=True), strict=True):
            use_sum(table, parts)

    def step(self, progress: float) -> None:
        """Do one step of Adam; ``progress`` is the share of the training that is over."""
        for table in self.tables:
            table.step(log_linear(progress, *LEARNING_RATE))

    def by_period(self) -> Tensor | None:
        """Return the transform of each period, as at first where it has no image. [T, 3, 4]"""
        if not self.tables:
            return None
        result = self._start.clone()
        for period in self._periods.unique().tolist():
            rows = self._rows[self._periods == period].unique()
            result[period] = self.tables[0].value[rows].mean(0)
        return result

    def state(self) -> dict[str, Tensor]:
        """Return everything that later steps depend on, by name."""
        return {name: t for table in self.tables for name, t in table.state().items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Go on from what `state` gave, with the same kind and views."""
        for table in self.tables:
            table.load_state(state)


def of_period(transforms: Tensor, period: float) -> Tensor:
    """Return the transform of a period, mixed between two as features are.

    Args:
        transforms: [T, 3, 4]
        period: 0..T-1.
    """
    count = len(transforms)
    weights = torch.from_numpy(period_weights(period if count > 1 else 0.0, count))
    return (transforms * weights.to(transforms)[:, None, None]).sum(0)


def transformed(image: Tensor, transform: Tensor) -> Tensor:
    """Compute A c + b for each pixel c, with [A b] the transform. [H, W, 3], [3, 4] -> [H, W, 3]

    Gradients have equal bits for any number of threads.
    """
    return _Transform.apply(image, transform)


def exposed(sh_coeffs: NDArray[np.float32], transform: NDArray[np.float32]) -> NDArray[np.float32]:
    """Transform spherical harmonics, so that the image need not be `transformed` any more.

    Equal where the Gaussians are opaque together: what is behind them stays as it is.

    Args:
        sh_coeffs: [N, K, 3]
        transform: [3, 4]
    """
    matrix, shift = transform[:, :3], transform[:, 3]
    result = sh_coeffs @ matrix.T
    result[:, 0] += (matrix.sum(axis=1) / 2 + shift - 0.5) / C0  # without coefficients: 1/2
    return result


class _Transform(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, transform: Tensor) -> Tensor:
        ctx.save_for_backward(image, transform)
        return _mixed(image, transform)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, Tensor]:
        image, transform = ctx.saved_tensors
        back = torch.nn.functional.pad(transform[:, :3].T, (0, 1))
        return _mixed(grads[0], back), _moments(grads[0], image)


def _mixed(image: Tensor, transform: Tensor) -> Tensor:
    """Compute `transformed`: its definition in torch, or compiled."""
    if not devices.has_kernels(image):
        return image @ transform[:, :3].T + transform[:, 3]
    result = torch.empty_like(image, memory_format=torch.contiguous_format)
    _mix_rows(devices.array_of(image), devices.array_of(transform), result.numpy())
    return result


def _moments(grad: Tensor, image: Tensor) -> Tensor:
    """Sum the gradient times (c, 1) over the pixels. [H, W, 3], [H, W, 3] -> [3, 4]"""
    if not devices.has_kernels(grad):
        products = torch.einsum("hwi,hwj->ij", grad, image)
        return torch.cat([products, grad.sum((0, 1))[:, None]], dim=1)
    sums = np.zeros((len(grad), 3, 4))
    _row_moments(devices.array_of(grad), devices.array_of(image), sums)
    return torch.from_numpy(sums.sum(axis=0)).to(grad)


@kernel(parallel=True)
def _mix_rows(  # type: ignore[no-untyped-def]
    image: NDArray[Any], t: NDArray[Any], result: NDArray[Any]
):
    for y in prange(len(image)):
        for x in range(image.shape[1]):
            r, g, b = image[y, x, 0], image[y, x, 1], image[y, x, 2]
            for i in range(3):
                result[y, x, i] = t[i, 0] * r + t[i, 1] * g + t[i, 2] * b + t[i, 3]


@kernel(parallel=True)
def _row_moments(  # type: ignore[no-untyped-def]
    grad: NDArray[Any], image: NDArray[Any], sums: NDArray[np.float64]
):
    for y in prange(len(grad)):
        for x in range(grad.shape[1]):
            for i in range(3):
                for j in range(3):
                    sums[y, i, j] += grad[y, x, i] * image[y, x, j]
                sums[y, i, 3] += grad[y, x, i]
