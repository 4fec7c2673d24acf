"""Scaffold-GS as a plug-in of the harness.

Source: Scaffold-GS (Lu et al., CVPR 2024) and its official code. The unused opacity logit of an
anchor and its rotation, which never gets a gradient, are left out.
"""

from __future__ import annotations

from chronoscene.anchors.method import AnchorMethod
from chronoscene.anchors.model import AnchorLayout


class ScaffoldGS(AnchorMethod):
    """Anchors with one feature each; whatever the period, the image is the same."""

    name = "scaffold-gs"

    def layout(self, num_periods: int) -> AnchorLayout:
        """One period for all."""
        return AnchorLayout.of(self.config, 1)
