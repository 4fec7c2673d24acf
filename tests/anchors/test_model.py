"""What a model with anchors is before training."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.model import AnchorLayout, AnchorModel


@pytest.mark.parametrize("offsets", [1, 5])
def test_no_model_begins_with_everything_switched_off(offsets: int) -> None:
    config = AnchorConfig(offsets_per_anchor=offsets)
    layout, around = AnchorLayout.of(config, 1), torch.cat([torch.eye(3), -torch.eye(3)])
    for seed in range(50):
        drawn = AnchorModel.start(
            layout, config, np.zeros((1, 3), np.float32), torch.Generator().manual_seed(seed)
        )
        shown = [
            drawn.decode(torch.ones(1), c, torch.arange(1)).opacities.max() > 0 for c in around
        ]
        assert np.mean(shown) >= 0.5
