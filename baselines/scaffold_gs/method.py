"""Scaffold-GS as a plug-in of the harness.

Source: Scaffold-GS (Lu et al., CVPR 2024) and its official code. The unused opacity logit of an
anchor and its rotation, which never gets a gradient, are left out.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from baselines.scaffold_gs.config import ScaffoldGSConfig
from chronoscene.anchors.method import AnchorMethod
from chronoscene.anchors.model import AnchorLayout


class ScaffoldGS(AnchorMethod):
    """Anchors with one feature each; whatever the period, the image is the same.

    Args:
        config: Options.
    """

    name = "scaffold-gs"

    def __init__(self, config: ScaffoldGSConfig) -> None:
        super().__init__(config)

    def layout(self, num_periods: int) -> AnchorLayout:
        return AnchorLayout.of(self.config, 1)

    def weights(self, period: float) -> NDArray[np.float32]:
        """One period for all: the given one is ignored. [1]"""
        return np.ones(1, np.float32)
