"""Gaussians that live for some periods: those in training, and those that stay as they are."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

import torch
from torch import Tensor

from chronoscene.gaussians.model import SHAPES, GaussianModel

LIVES = "lives"
"""Period in which a Gaussian begins, and in which it is there no more; 0 if it lasts. int32
[N, 2]"""
STRAYS = "strays"
"""Group of `parameters` that is not trained: checks, the last ones in a row, that found a Gaussian
outside of the spheres. [N]"""


@dataclass(eq=False)
class PeriodModel(GaussianModel):
    """Gaussians in training in `parameters`, which begin in `period`; all others in `kept`.

    What is drawn at a period are the kept Gaussians that live then, in their order, and after them
    those in training: a later stage, which keeps these as well, draws the same.
    """

    _: KW_ONLY
    kept: dict[str, Tensor]
    """Groups of `SHAPES` and `LIVES`; read only. [M, ...]"""
    period: int = 0
    """Period in training."""
    spheres: Tensor = field(default_factory=lambda: torch.zeros(0, 4))
    """Centres and radii of where Gaussians in training may be; none if anywhere. [S, 4]"""

    def __post_init__(self) -> None:
        self.parameters[STRAYS] = torch.zeros_like(self.parameters["logit_opacities"])
        self._living: tuple[int, dict[str, Tensor]] | None = None

    def at_period(self, period: float) -> Mapping[str, Tensor]:
        living = self.living(int(period))
        if period < self.period and len(self.kept[LIVES]):
            return living
        return {name: torch.cat([living[name], self.parameters[name]]) for name in SHAPES}

    def living(self, period: int) -> dict[str, Tensor]:
        """The kept Gaussians that are there at a period."""
        if self._living is None or self._living[0] != period:
            rows = self.living_rows(period)
            self._living = period, {name: self.kept[name][rows] for name in SHAPES}
        return self._living[1]

    def living_rows(self, period: int) -> Tensor:
        """Their rows in `kept`; before the first period that has any, those of that. int64"""
        begin, end = self.kept[LIVES].unbind(-1)
        if len(begin):
            period = max(period, int(begin.min()))
        return ((begin <= period) & ((end == 0) | (period < end))).nonzero()[:, 0]

    def rows(self, period: int) -> Tensor:
        """Rows of `everything` that are drawn at a period, the latest one of all. int64"""
        count, device = len(self.kept[LIVES]), self.kept[LIVES].device
        mine = torch.arange(count, count + len(self), device=device)
        return torch.cat([self.living_rows(period), mine])

    def everything(self) -> dict[str, Tensor]:
        """All Gaussians as they are stored, those in training last."""
        lives = self.kept[LIVES].new_zeros(len(self), 2)
        lives[:, 0] = self.period
        mine = {name: self.parameters[name].detach() for name in SHAPES} | {LIVES: lives}
        return {name: torch.cat([self.kept[name], rows]) for name, rows in mine.items()}

    def keep(self, kept: dict[str, Tensor]) -> None:
        """Put other Gaussians in the place of those that are kept."""
        self.kept, self._living, self.is_final = kept, None, False

    def begin(self, period: int, changed: Tensor, new: Mapping[str, Tensor]) -> None:
        """Keep all Gaussians, and train copies of those that changed, with new ones.

        Args:
            period: The new one. What changed ends before it.
            changed: Rows of `everything`. int64 [m]
            new: Groups of `SHAPES`, on any device. [n, ...]
        """
        kept = self.everything()
        kept[LIVES][changed, 1] = period
        self.keep(kept)
        self.period = period
        self.parameters = {
            name: torch.cat([kept[name][changed], new[name].to(kept[name])]) for name in SHAPES
        }
        self.parameters[STRAYS] = torch.zeros_like(self.parameters["logit_opacities"])


def no_gaussians(device: str | torch.device) -> dict[str, Tensor]:
    """Groups without a row, for `PeriodModel.kept`."""
    empty = {name: torch.zeros(0, *shape, device=device) for name, shape in SHAPES.items()}
    return empty | {LIVES: torch.zeros(0, 2, dtype=torch.int32, device=device)}
