"""Scaffold-GS as a plug-in of the harness.

Source: Scaffold-GS (Lu et al., CVPR 2024) and its official code. The unused opacity logit of an
anchor and its rotation, which never gets a gradient, are left out; so are the feature bank and the
distance as an input of the MLPs, which the paper has and all published scripts leave off.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from baselines.scaffold_gs.config import ScaffoldGSConfig
from chronoscene.anchors.method import AnchorMethod
from chronoscene.anchors.model import AnchorLayout
from chronoscene.methods import TrainingSet


class ScaffoldGSPeriod(AnchorMethod):
    """Scaffold-GS whose colour MLP sees a vector of the period: the least that time can be."""

    name = "scaffold-gs-period"
    config: ScaffoldGSConfig

    def layout(self, train: TrainingSet) -> AnchorLayout:
        dim = self.config.appearance_dim
        return replace(super().layout(train), global_dim=dim, global_heads=("color",))

    def rates(self, extent: float) -> dict[str, tuple[float, float]]:
        return super().rates(extent) | {"global_features": self.config.appearance_lr}


class ScaffoldGS(ScaffoldGSPeriod):
    """Anchors with one feature each; whatever the period, the image is the same.

    With `ScaffoldGSConfig.appearance_dim`, the colour MLP sees a vector of the training image. No
    image is known at test time, so the mean vector is used.
    """

    name = "scaffold-gs"

    def layout(self, train: TrainingSet) -> AnchorLayout:
        vectors = len(train.views) if self.config.appearance_dim else 1
        return replace(super().layout(train), num_periods=vectors)

    def feature_rows(self, train: TrainingSet) -> NDArray[np.int64]:
        count = len(train.views)
        return np.arange(count) if self.config.appearance_dim else np.zeros(count, np.int64)

    def extended_table(self, table: Tensor, count: int) -> Tensor:
        """Vectors of other training images, which start at the mean of those before."""
        return table.detach().mean(dim=0, keepdim=True).repeat(count, 1)

    def weights(self, period: float) -> NDArray[np.float32]:
        return np.full(self.num_periods, 1 / self.num_periods, np.float32)
