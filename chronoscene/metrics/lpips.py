"""LPIPS with VGG16, version 0.1, without torchvision and without the ``lpips`` package.

Source: Zhang et al. 2018, eq. 1, with the constants of the authors' release 0.1. Inputs are
shifted and scaled per channel, five activations of VGG16 are normalised to unit length over their
channels, and the squared differences, weighted per channel, are averaged over the image and
summed over the five.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn import functional

from chronoscene.errors import ShapeError
from chronoscene.metrics.lpips_weights import CONVOLUTIONS, LpipsWeights, load_weights
from chronoscene.metrics.psnr_ssim import unit_float

SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
"""Per RGB channel: the mean and deviation of ImageNet, moved to inputs in [-1, 1]."""
EPSILON = 1e-10  # Added to the length of a feature vector before the division
MIN_SIZE = 16  # Pixels per axis that survive the four poolings of VGG16


class Lpips:
    """The metric with its weights in memory. No gradients."""

    def __init__(self, weights: LpipsWeights) -> None:
        self.backbone, self.heads = weights.backbone, weights.heads
        self.shift = torch.tensor(SHIFT).reshape(1, 3, 1, 1)
        self.scale = torch.tensor(SCALE).reshape(1, 3, 1, 1)

    def features(self, image: Tensor) -> list[Tensor]:
        """Activations relu1_2, relu2_2, relu3_3, relu4_3 and relu5_3. [1, 3, H, W] -> 5 maps"""
        x = (image - self.shift) / self.scale
        taps = []
        for number, layers in enumerate(CONVOLUTIONS):
            if number:
                x = functional.max_pool2d(x, 2)
            for index, _, _ in layers:
                weight, bias = self.backbone[f"{index}.weight"], self.backbone[f"{index}.bias"]
                x = functional.relu(functional.conv2d(x, weight, bias, padding=1))
            taps.append(x)
        return taps

    def distance(self, a: Tensor, b: Tensor) -> float:
        """LPIPS of two inputs as they are: no scaling is applied here. [1, 3, H, W]"""
        total = 0.0
        with torch.inference_mode():
            pairs = zip(self.features(a), self.features(b), self.heads, strict=True)
            for feature_a, feature_b, head in pairs:
                difference = (unit_length(feature_a) - unit_length(feature_b)) ** 2
                weighted = (difference * head.reshape(1, -1, 1, 1)).sum(dim=1)
                total += float(weighted.mean())
        return total

    def vgg(self, image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
        """``lpips_vgg``: inputs in [-1, 1], as the authors define it.

        Args:
            image: [H, W, 3]
            reference: [H, W, 3]
            mask: Pixels that count: the value is divided by their share. The images are to be equal
                elsewhere. [H, W] bool
        """
        value = self.distance(2 * self._tensor(image) - 1, 2 * self._tensor(reference) - 1)
        return value / _share(mask)

    def vgg_3dgs(
        self, image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None
    ) -> float:
        """``lpips_vgg_3dgs``: inputs in [0, 1], comparable with 3DGS papers; otherwise as `vgg`."""
        return self.distance(self._tensor(image), self._tensor(reference)) / _share(mask)

    def _tensor(self, image: ArrayLike) -> Tensor:
        array = unit_float(image)
        if array.shape[2] != 3 or min(array.shape[:2]) < MIN_SIZE:
            raise ShapeError(
                "image",
                expected=f"three channels and at least {MIN_SIZE} x {MIN_SIZE} pixels for LPIPS",
                found=str(list(array.shape)),
                todo="use another metric, or evaluate larger images",
            )
        return torch.from_numpy(array).float().permute(2, 0, 1)[None]


def _share(mask: ArrayLike | None) -> float:
    return 1.0 if mask is None else float(np.asarray(mask, bool).mean())


def unit_length(feature: Tensor) -> Tensor:
    """Scale the channels of every pixel to length 1. [1, C, H, W]"""
    length = torch.sqrt((feature**2).sum(dim=1, keepdim=True))
    return feature / (length + EPSILON)


def lpips_metrics(weights: Path | None = None) -> dict[str, Callable[..., float]]:
    """Both variants by metric name.

    Raises:
        MetricUnavailableError: If the weights are not on this machine; says what to put where.
    """
    metric = Lpips(load_weights(weights))
    return {"lpips_vgg": metric.vgg, "lpips_vgg_3dgs": metric.vgg_3dgs}
