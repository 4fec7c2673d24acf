"""ChronoGS as a plug-in of the harness.

Source: ChronoGS (arXiv 2511.18794) and the official code; where they differ, `ChronoGSConfig`
names both. `model` holds what is special about it; the rest is shared with Scaffold-GS.
"""

from __future__ import annotations

from chronogs.config import ChronoGSConfig
from chronogs.model import ChronoGSModel
from chronoscene.anchors.method import AnchorMethod


class ChronoGS(AnchorMethod):
    """Anchors with a shared feature, one feature per period, and one global feature per period."""

    name = "chronogs"
    model_class = ChronoGSModel
    config: ChronoGSConfig

    @property
    def merge_share(self) -> float:
        return self.config.merge_share

    def rates(self, camera_extent: float) -> dict[str, tuple[float, float]]:
        return super().rates(camera_extent) | {"global_features": self.config.global_lr}
