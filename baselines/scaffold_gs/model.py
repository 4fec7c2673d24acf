"""The feature bank of Scaffold-GS: features that the view mixes from three resolutions.

With d_i the viewing direction of an anchor i, l_i its distance from the camera and f_i its feature,

    w_i = softmax(MLP(d_i, l_i))                   three weights,
    f_i(view) = w_i0 f_i[::4] + w_i1 f_i[::2] + w_i2 f_i,

where f_i[::4] and f_i[::2] are repeated to the length of f_i. The other MLPs see the mixture in
place of f_i.

Source: Scaffold-GS (Lu et al., CVPR 2024), section 3.2, and the official code. Mixtures are
computed in torch, on any device, and then decoded by `chronoscene.anchors.decode`.
"""

from __future__ import annotations

from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.decode import mlp
from chronoscene.anchors.decode.layout import MIN_DISTANCE
from chronoscene.anchors.model import BANK, AnchorLayout, AnchorModel, draw_mlp


class ScaffoldModel(AnchorModel):
    """Anchors, with a feature bank if the layout says so."""

    @classmethod
    def start(
        cls,
        layout: AnchorLayout,
        config: AnchorConfig,
        anchors: NDArray[np.float32],
        generator: torch.Generator,
    ) -> Self:
        model = super().start(layout, config, anchors, generator)
        if layout.feature_bank:
            bank = draw_mlp(4, layout.hidden_dim, 3, generator)
            model.heads = {**model.heads, BANK: bank}
        return model

    def seen_features(self, centre: Tensor) -> Tensor:
        features, layout = super().seen_features(centre), self.layout
        if not layout.feature_bank:
            return features
        distances = self.distances(centre)
        directions = (self.anchors - centre) / distances.clamp(min=MIN_DISTANCE)
        sight = torch.cat([directions, layout.distance_scale * distances], dim=1)
        weights = torch.softmax(mlp(sight, self.heads[BANK]), dim=1)
        own, rest = features[:, : layout.base_dim], features[:, layout.base_dim :]
        coarse, middle = own[:, ::4].repeat(1, 4), own[:, ::2].repeat(1, 2)
        mixed = weights[:, :1] * coarse + weights[:, 1:2] * middle + weights[:, 2:] * own
        return torch.cat([mixed, rest], dim=1)
