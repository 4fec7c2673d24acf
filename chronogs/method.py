"""ChronoGS as a plug-in of the harness.

Source: ChronoGS (arXiv 2511.18794) and the official code; where they differ, `ChronoGSConfig`
names both. `model` holds what is special about it; the rest is shared with Scaffold-GS.
"""

from __future__ import annotations

from dataclasses import replace

from chronogs.config import ChronoGSConfig
from chronogs.model import ChronoGSModel
from chronoscene.anchors.method import AnchorMethod
from chronoscene.anchors.model import AnchorLayout
from chronoscene.methods import TrainingSet


class ChronoGS(AnchorMethod):
    """Anchors with a shared feature, one feature per period, and one global feature per period."""

    name = "chronogs"
    model_class = ChronoGSModel
    config: ChronoGSConfig

    def layout(self, train: TrainingSet) -> AnchorLayout:
        layout = super().layout(train)
        if not self.config.trim_global:
            return layout
        return replace(layout, global_dim=min(layout.global_dim, train.num_periods - 1))

    @property
    def merge_share(self) -> float:
        return self.config.merge_share

    @property
    def period_decay(self) -> float:
        return self.config.period_decay

    def rates(self, extent: float) -> dict[str, tuple[float, float]]:
        return super().rates(extent) | {"global_features": self.config.global_lr}
