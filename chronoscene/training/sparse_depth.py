"""Term of the loss that holds the surfaces of a model to the sparse points (option `depth_weight`).

Source: Deng et al. 2022, DS-NeRF, which weighs squared deviations by errors of reprojection.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from chronoscene.methods import TrainingSet
from chronoscene.rasterizer import Rasterization
from chronoscene.training.devices import to_device
from chronoscene.training.losses import steady_mean

INTERVAL = 4
"""Every so many views one has the term. Depth makes an image and its gradients a fifth slower."""


class DepthTarget(NamedTuple):
    """Depths of sparse points in the view of a step."""

    pixels: Tensor
    """Row times width plus column, each once. int64 [S]"""
    depths: Tensor
    """float32 [S]"""
    weight: float
    """Factor of the term in the loss."""

    def term(self, rendered: Tensor, alphas: Tensor) -> Tensor:
        """Compute weight times mean of ``opacity |rendered / depth - 1|``.

        It has no unit, and a few points in wrong places count little. Where there is hardly
        anything, the depth, which is divided by the opacity, is hardly known: such pixels count as
        little. The factor has no gradient, as the term would fade what is misplaced.

        Args:
            rendered: Depth of the model. [H, W, 1]
            alphas: Opacity. [H, W, 1]

        Returns:
            A scalar.
        """
        ratios = rendered.flatten()[self.pixels] / self.depths
        known = alphas.detach().flatten()[self.pixels]
        return self.weight * steady_mean(known * (ratios - 1).abs())

    def term_of(self, raster: Rasterization) -> Tensor:
        """Compute `term` of a view that was drawn alone and with depth."""
        assert raster.depths is not None
        return self.term(raster.depths[0], raster.alphas[0])


class SparseDepth:
    """Depths of sparse points in the training views, as tensors.

    Args:
        weight: Mean weight of the term; 0: there is none.
        train: Has the depths.
        device: Of the tensors.
    """

    def __init__(self, weight: float, train: TrainingSet, device: torch.device) -> None:
        self.weight, self._train, self._device = weight, train, device
        self._kept: dict[int, DepthTarget] = {}

    def target(self, number: int, drawn: int) -> DepthTarget | None:
        """Return that of a view; None where the step has no such term, or the view no points.

        Args:
            number: Of the view.
            drawn: Number of views drawn so far.
        """
        if not self.weight or drawn % INTERVAL:
            return None
        if number not in self._kept:
            pixels, depths = (to_device(x, self._device) for x in self._train.load_depths(number))
            self._kept[number] = DepthTarget(pixels, depths, INTERVAL * self.weight)
        target = self._kept[number]
        return target if len(target.pixels) else None
