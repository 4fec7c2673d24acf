"""Options of Scaffold-GS. The defaults are the official command line's."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.anchors.config import AnchorConfig


@dataclass(frozen=True)
class ScaffoldGSConfig(AnchorConfig):
    """No appearance vectors, no feature bank, no view distance: as in all published scripts.

    Scaffold-GS with an appearance vector per period is ChronoGS with ``period_dim`` 0, ``base_dim``
    32 and ``global_heads`` ``("color",)``.
    """

    iterations: int = 30_000
    base_dim: int = 32
    """Length of the feature of an anchor."""
    statistics_from: float = 500 / 30_000
    density_from: float = 1_500 / 30_000
