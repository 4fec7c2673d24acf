"""Options of ChronoGS. The defaults are the official code's, which is the preset ``paper``."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from pydantic import NonNegativeFloat, NonNegativeInt

from chronoscene.anchors.config import HEADS, AnchorConfig, Head
from chronoscene.errors import ConfigError


@dataclass(frozen=True)
class ChronoGSConfig(AnchorConfig):
    """Options of ChronoGS; those in which paper and code differ name both."""

    period_dim: NonNegativeInt = 16
    """Length of an anchor's feature per period (d_v); 0: without local changes."""
    global_dim: NonNegativeInt = 32
    """Length of the feature of a period (d_g); 0: without global changes."""
    trim_global: bool = False
    """True to make it no longer than the number of periods less one: as the MLPs have a bias, that
    many numbers tell the periods apart as freely as more would. One period has none then. Not in
    the paper."""
    merge_share: NonNegativeFloat = 0.0
    """Share by which the loss may rise, by estimate, where features of an anchor at several periods
    become one once growth is over, as they are alike: see `chronoscene.anchors.blocks`. 0: none
    (paper and code)."""
    period_decay: NonNegativeFloat = 0.0
    """Decay of an anchor's features of the periods towards their mean, in multiples of their
    learning rate per view: they differ only where the photos do, and elsewhere learn from the
    photos of all periods. Periods without training views take no part. 0: none (paper and
    code)."""
    fusion: Literal["concat", "sum"] = "concat"
    """``concat``: base, period and global feature side by side (code); ``sum``: added (formula of
    the paper; needs equal lengths)."""
    global_init: Literal["gaussian", "zero", "uniform"] = "gaussian"
    """``gaussian``: standard normal (code); ``zero`` (paper: all features start at zero);
    ``uniform``: within -1..1."""
    global_lr: tuple[float, float] = (0.05, 0.0005)
    """Learning rate of the features of periods; not given in the paper."""
    global_heads: tuple[Head, ...] = HEADS
    """MLPs that see the global feature; all three in paper and code. ``("color",)`` with
    ``period_dim`` 0 is Scaffold-GS with an appearance vector per period."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.fusion == "sum" and self.trim_global:
            raise ConfigError(
                "trim_global",
                expected="False with fusion=sum, which adds features of one length",
                found="True",
                todo="set trim_global=false, or use fusion=concat",
            )
        lengths = (self.base_dim, self.period_dim, self.global_dim)
        if self.fusion == "sum" and len({n for n in lengths if n}) > 1:
            raise ConfigError(
                "fusion=sum",
                expected="base, period and global features of one length (or 0)",
                found=", ".join(map(str, lengths)),
                todo="set the three dimensions alike, or use fusion=concat",
            )
