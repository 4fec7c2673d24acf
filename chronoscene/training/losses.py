"""Terms of the loss of a training step.

`training_loss` is what both trainers minimise, `AnchorTrainer` and `GaussianTrainer`; each adds
the terms of its own kind of models, such as `mean_volume`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from chronoscene.kernels.compilation import kernel
from chronoscene.rasterizer import Rasterization
from chronoscene.training import devices
from chronoscene.training.config import SplattingConfig
from chronoscene.training.exposure import Exposure
from chronoscene.training.photometric import photometric_loss

_ROW = 1024
"""Numbers that one thread sums in `steady_mean`."""

_CHUNK = 4096
"""Gaussians summed one after the other; fixed, so the sum does not depend on the threads."""


def training_loss(
    raster: Rasterization,
    photo: Tensor,
    mask: Tensor | None,
    *,
    number: int,
    exposure: Exposure,
    config: SplattingConfig,
    compare: Callable[[Tensor, Tensor, Tensor | None], Tensor] | None = None,
) -> Tensor:
    """Compute the loss that all methods share, for one training view.

    A term of image and photo for all methods is added here, and its weight as an option of
    `SplattingConfig`; that of depth is in `chronoscene.training.sparse_depth`.

    Args:
        raster: The view as it was drawn.
        photo: uint8 0..255. [H, W, 3]
        mask: Where the photo counts; None for everywhere. bool [H, W]
        number: Of the view.
        exposure: Has the transform of the colours of the view.
        config: Has the weights of the terms.
        compare: Compares image, photo and mask in place of `photometric_loss`.

    Returns:
        A scalar.
    """
    image = exposure.apply(raster.image[0], number)
    if compare is not None:
        return compare(image, photo, mask)
    return photometric_loss(image, photo, ssim_weight=config.ssim_weight, mask=mask)


def steady_mean(values: Tensor) -> Tensor:
    """Compute the mean of all numbers; equal to the last bit for any number of threads.

    The sum of torch is split among the threads from 32,768 numbers on. Here rows are summed each by
    one thread, and then their sums, which are too few to be split. The gradient is that of `mean`.

    Args:
        values: Up to 33 million numbers, of any shape.
    """
    count = values.numel()
    rows = torch.nn.functional.pad(values.flatten(), (0, -count % _ROW)).view(-1, _ROW)
    return rows.sum(1).sum() / count


def mean_volume(scales: Tensor, opacities: Tensor) -> Tensor:
    """Compute the mean product of the scales of the Gaussians with an opacity above 0.

    As a term of the loss, it keeps them small.

    Args:
        scales: [N, 3]
        opacities: Only their sign counts; they get no gradient. [N]

    Returns:
        Scalar; 0 where no Gaussian is switched on.

    Source: the official code of Scaffold-GS and ChronoGS (the ChronoGS paper leaves the term out).
    """
    if not devices.has_kernels(scales):
        active = opacities > 0
        a, b, c = scales.unbind(-1)
        return torch.where(active, a * b * c, 0).sum() / active.sum().clamp_min(1)
    return _MeanVolume.apply(scales, opacities)


def add_mean_volume(scales: Tensor, opacities: Tensor, weight: float, gradient: Tensor) -> Tensor:
    """Return the weight times `mean_volume`, and add its gradient in the scales.

    Args:
        scales: float32 on the CPU, without a graph. [N, 3]
        opacities: [N]
        weight: Of the term in the loss.
        gradient: Changed in place. [N, 3]
    """
    value, count = _volume(scales, opacities)
    factor = np.float32(float(np.float32(weight)) / count)
    # By itself, as the compiler would round product and sum once.
    own = np.empty_like(scales.numpy())
    _volume_gradients(scales.numpy(), opacities.numpy(), factor, own)
    np.add(gradient.numpy(), own, out=gradient.numpy())
    return weight * value


def _volume(scales: Tensor, opacities: Tensor) -> tuple[Tensor, int]:
    """Return the mean volume, and of how many Gaussians it is."""
    chunks = -(-len(scales) // _CHUNK)
    sums, counts = np.zeros(chunks), np.zeros(chunks, np.int64)
    _sum_volumes(scales.detach().numpy(), opacities.detach().numpy(), sums, counts)
    count = max(int(counts.sum()), 1)
    return scales.new_tensor(sums.sum() / count), count


class _MeanVolume(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, scales: Tensor, opacities: Tensor) -> Tensor:
        value, ctx.count = _volume(scales, opacities)
        ctx.save_for_backward(scales, opacities)
        return value

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None]:
        scales, opacities = ctx.saved_tensors
        result = torch.empty_like(scales)
        factor = scales.numpy().dtype.type(grads[0].item() / ctx.count)
        _volume_gradients(scales.detach().numpy(), opacities.numpy(), factor, result.numpy())
        return result, None


@kernel(parallel=True)
def _sum_volumes(scales, opacities, sums, counts):  # type: ignore[no-untyped-def]
    for c in prange(len(sums)):
        total, count = 0.0, 0
        for i in range(c * _CHUNK, min((c + 1) * _CHUNK, len(scales))):
            if opacities[i] > 0.0:
                total += scales[i, 0] * scales[i, 1] * scales[i, 2]
                count += 1
        sums[c], counts[c] = total, count


@kernel(parallel=True)
def _volume_gradients(scales, opacities, factor, result):  # type: ignore[no-untyped-def]
    for i in prange(len(scales)):
        f = factor if opacities[i] > 0.0 else factor * 0.0
        a, b, c = scales[i, 0], scales[i, 1], scales[i, 2]
        result[i, 0], result[i, 1], result[i, 2] = f * b * c, f * a * c, f * a * b
