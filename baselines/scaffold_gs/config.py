"""Options of Scaffold-GS. The defaults are those of the released script for Mip-NeRF 360."""

from __future__ import annotations

from dataclasses import dataclass

from pydantic import NonNegativeInt, PositiveInt

from chronoscene.anchors.config import AnchorConfig, Share


@dataclass(frozen=True)
class ScaffoldGSConfig(AnchorConfig):
    """Options of Scaffold-GS beside those of all methods with anchors."""

    iterations: PositiveInt = 30_000
    base_dim: NonNegativeInt = 32
    """Length of the feature of an anchor."""
    statistics_from: Share = 500 / 30_000
    density_from: Share = 1_500 / 30_000
    appearance_dim: NonNegativeInt = 0
    """Length of the appearance vectors that the colour MLP sees; 0: none. Released scripts have 32
    for photos by tourists, else 0. ``scaffold-gs`` has one per training image and renders with
    their mean, ``scaffold-gs-period`` one per period."""
    appearance_lr: tuple[float, float] = (0.05, 0.0005)
    """Learning rate of the appearance vectors."""
