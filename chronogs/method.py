"""ChronoGS as a plug-in of the harness.

Source: ChronoGS (arXiv 2511.18794) and the official code; where they differ, `ChronoGSConfig`
names both. `model` holds what is special about it; the rest is shared with Scaffold-GS.
"""

from __future__ import annotations

from torch import Tensor

from chronogs.config import ChronoGSConfig
from chronogs.model import ChronoGSModel
from chronogs.sharing import pack_features, share_periods, unpack_features
from chronoscene.anchors.method import AnchorMethod
from chronoscene.anchors.model import AnchorLayout
from chronoscene.anchors.trainer import AfterUpdate


class ChronoGS(AnchorMethod):
    """Anchors with a shared feature, one feature per period, and one global feature per period."""

    name = "chronogs"
    model_class = ChronoGSModel
    config: ChronoGSConfig

    def rates(self, camera_extent: float) -> dict[str, tuple[float, float]]:
        return super().rates(camera_extent) | {"global_features": self.config.global_lr}

    def after_update(self) -> AfterUpdate | None:
        weight = self.config.period_sharing
        if not weight or self.num_periods == 1:
            return None
        return lambda model, rates: share_periods(model, rates["features"] * weight)

    def stored_tensors(self) -> dict[str, Tensor]:
        return pack_features(super().stored_tensors(), self._model.layout)

    def restored_tensors(
        self, stored: dict[str, Tensor], layout: AnchorLayout
    ) -> dict[str, Tensor]:
        return super().restored_tensors(unpack_features(stored, layout), layout)
