"""Scaffold-GS as a plug-in of the harness.

Source: Scaffold-GS (Lu et al., CVPR 2024) and its official code. The unused opacity logit of an
anchor and its rotation, which never gets a gradient, are left out.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from baselines.scaffold_gs.config import ScaffoldGSConfig
from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.method import AnchorMethod
from chronoscene.anchors.model import AnchorLayout, AnchorModel, draw_start
from chronoscene.methods import TrainingSet
from chronoscene.training.periods import period_weights


class AppearanceModel(AnchorModel):
    """Appearance vectors start like any embedding: standard normal."""

    @classmethod
    def start(
        cls,
        layout: AnchorLayout,
        config: AnchorConfig,
        anchors: NDArray[np.float32],
        generator: torch.Generator,
    ) -> Self:
        model = super().start(layout, config, anchors, generator)
        shape = (layout.num_periods, layout.global_dim)
        model.global_features = draw_start(shape, "gaussian", 1.0, generator)
        return model


class ScaffoldGS(AnchorMethod):
    """Anchors with one feature each; whatever the period, the image is the same.

    With `ScaffoldGSConfig.appearance_dim`, the colour MLP also sees a vector of the training image.
    No image is known at test time, so the mean vector is used.
    """

    name = "scaffold-gs"
    model_class = AppearanceModel
    config: ScaffoldGSConfig

    def layout(self, train: TrainingSet) -> AnchorLayout:
        dim = self.config.appearance_dim
        layout = AnchorLayout.of(self.config, self.count_vectors(train) if dim else 1)
        return replace(layout, global_dim=dim, global_heads=("color",))

    def count_vectors(self, train: TrainingSet) -> int:
        """How many appearance vectors there are."""
        return len(train.views)

    def feature_rows(self, train: TrainingSet) -> NDArray[np.int64]:
        count = len(train.views)
        return np.arange(count) if self.config.appearance_dim else np.zeros(count, np.int64)

    def rates(self, camera_extent: float) -> dict[str, tuple[float, float]]:
        return super().rates(camera_extent) | {"global_features": self.config.appearance_lr}

    def weights(self, period: float) -> NDArray[np.float32]:
        return np.full(self.num_periods, 1 / self.num_periods, np.float32)


class ScaffoldGSPeriod(ScaffoldGS):
    """Scaffold-GS whose colour MLP sees a vector of the period: the least that time can be."""

    name = "scaffold-gs-period"

    def count_vectors(self, train: TrainingSet) -> int:
        return train.num_periods

    def feature_rows(self, train: TrainingSet) -> NDArray[np.int64]:
        return AnchorMethod.feature_rows(self, train)

    def weights(self, period: float) -> NDArray[np.float32]:
        return period_weights(period, self.num_periods)
