"""Options of ChronoGS. The defaults are the official code's, which is the preset ``paper``."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.anchors.config import HEADS, AnchorConfig
from chronoscene.checks import check_at_least, check_choice
from chronoscene.errors import ConfigError


@dataclass(frozen=True)
class ChronoGSConfig(AnchorConfig):
    """Where paper and official code differ, the option names both and defaults to the code."""

    period_dim: int = 16
    """Length of an anchor's feature per period (d_v); 0: without local changes."""
    global_dim: int = 32
    """Length of the feature of a period (d_g); 0: without global changes."""
    trim_global: bool = False
    """Whether it is no longer than the number of periods less one: as the MLPs have a bias, that
    many numbers tell the periods apart as freely as more would. One period has none then. Not in
    the paper."""
    merge_share: float = 0.0
    """Once growth is over, features of an anchor at several periods become one where they are
    alike, as many as raise the loss by no more than this share, by estimate: see
    `chronoscene.anchors.blocks`. 0: none (paper and code)."""
    fusion: str = "concat"
    """``concat``: base, period and global feature side by side (code); ``sum``: added (formula of
    the paper; needs equal lengths)."""
    global_init: str = "gaussian"
    """``gaussian``: standard normal (code); ``zero`` (paper: all features start at zero);
    ``uniform``: within -1..1."""
    global_lr: tuple[float, float] = (0.05, 0.0005)
    """Not given in the paper."""
    global_heads: tuple[str, ...] = HEADS
    """MLPs that see the global feature; all three in paper and code. ``("color",)`` with
    ``period_dim`` 0 is Scaffold-GS with an appearance vector per period."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_choice("fusion", self.fusion, ("concat", "sum"))
        check_choice("global_init", self.global_init, ("gaussian", "zero", "uniform"))
        for head in self.global_heads:
            check_choice("global_heads", head, HEADS)
        for name in ("period_dim", "global_dim", "merge_share"):
            check_at_least(name, getattr(self, name), 0)
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
