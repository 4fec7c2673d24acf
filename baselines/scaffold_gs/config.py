"""Options of Scaffold-GS. The defaults are the official command line's."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

from chronoscene.anchors.config import HEADS, AnchorConfig
from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError


@dataclass(frozen=True)
class ScaffoldGSConfig(AnchorConfig):
    """Options of Scaffold-GS beside those of all methods with anchors."""

    iterations: int = 30_000
    base_dim: int = 32
    """Length of the feature of an anchor."""
    statistics_from: float = 500 / 30_000
    density_from: float = 1_500 / 30_000
    appearance_dim: int = 0
    """Length of the appearance vectors that the colour MLP sees; 0, none, in all published scripts.
    ``scaffold-gs`` has one per training image and renders with their mean,
    ``scaffold-gs-period`` one per period."""
    appearance_lr: tuple[float, float] = (0.05, 0.0005)
    """Of the appearance vectors."""
    feature_bank: bool = False
    """Mix the feature of an anchor at three resolutions, by viewing direction and distance: in the
    paper, and ``use_feat_bank`` in the official code, where all published scripts leave it off."""
    bank_lr: tuple[float, float] = (0.01, 0.00001)
    """Of the MLP that mixes."""
    distance_heads: tuple[str, ...] = ()
    """MLPs that see the distance of the camera too: all three in the paper; ``add_opacity_dist``,
    ``add_cov_dist`` and ``add_color_dist`` in the official code, off in all published scripts."""
    distance_scale: float = 1.0
    """Distances are given to MLPs in `length_unit`, times this."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for head in self.distance_heads:
            check_choice("distance_heads", head, HEADS)
        if self.feature_bank and self.base_dim % 4:
            raise ConfigError(
                "base_dim",
                expected="a multiple of 4, as there is a feature bank",
                found=str(self.base_dim),
                todo="correct the value, or leave feature_bank off",
            )

    def in_training_frame(self, training_from_world: float) -> Self:
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        return replace(config, distance_scale=self.distance_scale / training_from_world)
