"""The photometric loss between a rendered image and a photo: compiled for both kinds of devices,
and in plain torch.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.training import devices
from chronoscene.training.photometric import ssim_torch
from chronoscene.training.photometric.ssim_kernel import CHANNELS, RADIUS, SIGMA, l1_ssim


def photometric_loss(
    image: Tensor, target: Tensor, *, ssim_weight: float = 0.2, mask: Tensor | None = None
) -> Tensor:
    """Compute L1 and structural dissimilarity, differentiable in the image.

        loss = (1 - w) mean|I - T| + w (1 - SSIM(I, T))

    SSIM has an 11x11 Gaussian window of sigma 1.5, zero padding, constants 0.01² and 0.03², and is
    the mean over pixels and channels. In float32, value and gradient come from one pass: compiled,
    and on a CPU with equal bits for any number of threads. Other types go through
    `photometric_loss_reference`.

    Args:
        image: 0..1. float32 [H, W, 3]
        target: uint8 0..255, or float32 0..1. [H, W, 3]
        ssim_weight: w.
        mask: Where the target counts; None for everywhere. bool [H, W]

    Returns:
        A scalar. With a mask, both images are equal to `image` where it ignores, and the mean over
        all pixels is divided by the share of those that count: ignored pixels get no gradient, and
        the target makes no difference there. Nearly 0 where nothing counts.

    Raises:
        ShapeError: If the images differ in size, or have other types.

    Source: Kerbl et al. 2023 (3D Gaussian Splatting); Wang et al. 2004 for SSIM.
    """
    _check_images(image, target)
    if mask is not None:
        image, target, share = _where_it_counts(image, target, mask)
        return photometric_loss(image, target, ssim_weight=ssim_weight) / share
    if image.dtype != torch.float32:
        return photometric_loss_reference(image, target, ssim_weight=ssim_weight)
    return _PhotometricLoss.apply(image, target, ssim_weight)


def photometric_loss_reference(
    image: Tensor, target: Tensor, *, ssim_weight: float = 0.2, mask: Tensor | None = None
) -> Tensor:
    """Compute `photometric_loss` in plain torch, in the type of ``image``: its definition."""
    _check_images(image, target)
    if mask is not None:
        image, target, share = _where_it_counts(image, target, mask)
        return photometric_loss_reference(image, target, ssim_weight=ssim_weight) / share
    # In float32 as in the kernel, so that both agree on where the image equals the target.
    truth = _unit_range(target).to(image)
    l1 = (image - truth).abs().mean()
    return (1 - ssim_weight) * l1 + ssim_weight * (1 - ssim_map(image, truth).mean())


def _unit_range(target: Tensor) -> Tensor:
    return target.float() / 255 if target.dtype == torch.uint8 else target


def _where_it_counts(image: Tensor, target: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return both images, equal and constant where the mask ignores, and the share that counts."""
    check_shape("mask", mask, tuple(image.shape[:2]))
    counts, fixed = mask[..., None], image.detach()
    share = (mask.sum().clamp_min(1).double() / mask.numel()).to(image.dtype)
    truth = _unit_range(target).to(image)
    return torch.where(counts, image, fixed), torch.where(counts, truth, fixed), share


def ssim_map(image: Tensor, target: Tensor) -> Tensor:
    """Compute structural similarity per pixel and channel, zero padding. [H, W, 3]"""
    taps = torch.arange(-RADIUS, RADIUS + 1, dtype=torch.float64)
    taps = torch.exp(-taps.square() / (2 * SIGMA**2))
    window = torch.outer(taps, taps).div(taps.sum() ** 2).to(image)[None, None]

    def blur(values: Tensor) -> Tensor:
        planes = values.movedim(-1, 0)[:, None]
        blurred = torch.nn.functional.conv2d(planes, window, padding=RADIUS)
        return blurred[:, 0].movedim(0, -1)

    mu, nu = blur(image), blur(target)
    variances = blur(image.square()) - mu.square() + blur(target.square()) - nu.square()
    covariance = blur(image * target) - mu * nu
    numerator = (2 * mu * nu + 0.01**2) * (2 * covariance + 0.03**2)
    return numerator / ((mu.square() + nu.square() + 0.01**2) * (variances + 0.03**2))


def loss_and_gradient(
    image: Tensor, target: Tensor, *, ssim_weight: float = 0.2
) -> tuple[Tensor, Tensor]:
    """Compute `photometric_loss` of float32 images, and its gradient in the image, without a graph.

    Arguments as there.
    """
    _check_images(image, target)
    return _loss_and_gradient(image, target, ssim_weight, True)


def _loss_and_gradient(
    image: Tensor, target: Tensor, ssim_weight: float, wants_gradient: bool
) -> tuple[Tensor, Tensor]:
    count = image.numel()
    weights = ((1 - ssim_weight) / count, ssim_weight / count)
    if devices.has_gpu_kernels(image):
        from chronoscene.training.photometric import ssim_gpu

        return ssim_gpu.l1_ssim(image.detach(), target, weights)
    if not devices.has_kernels(image):
        return ssim_torch.l1_ssim(image, _unit_range(target), weights)
    gradient = torch.empty(image.shape if wants_gradient else (0, *image.shape[1:]))
    is_byte = target.dtype == torch.uint8
    arrays = _rows(image), _rows(target if is_byte else target.float())
    scales = np.float32(255 if is_byte else 1), np.array(weights, dtype=np.float32)
    difference, dissimilarity = l1_ssim(*arrays, *scales, _rows(gradient))
    return torch.tensor(weights[0] * difference + weights[1] * dissimilarity), gradient


class _PhotometricLoss(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, image: Tensor, target: Tensor, ssim_weight: float) -> Tensor:
        wants = bool(ctx.needs_input_grad[0])
        value, gradient = _loss_and_gradient(image, target, ssim_weight, wants)
        ctx.save_for_backward(gradient)
        return value

    @staticmethod
    def backward(ctx: Any, *outputs: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return gradient * outputs[0], None, None


def _rows(image: Tensor) -> np.ndarray[Any, Any]:
    width = image.shape[1] * CHANNELS
    return image.detach().contiguous().view(image.shape[0], width).numpy()


def _check_images(image: Tensor, target: Tensor) -> None:
    check_shape("image", image, (None, None, CHANNELS))
    check_shape("target", target, tuple(image.shape))
    if image.numel() == 0:
        raise ShapeError(
            "image",
            expected="at least one pixel",
            found=str(list(image.shape)),
            todo="render at least one pixel",
        )
    known = target.dtype == torch.uint8 or target.is_floating_point()
    if not image.is_floating_point() or not known:
        raise ShapeError(
            "target",
            expected="a float image and a uint8 or float target",
            found=f"{image.dtype} and {target.dtype}",
            todo="convert one of them",
        )
