"""Strategies: how a method is trained on the periods of a scene."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.methods import MethodSpec


@dataclass(frozen=True, slots=True)
class Strategy:
    """What distinguishes a strategy from the others."""

    tells_period: bool
    """Whether models are told the period; else they are asked for period 0 whatever it is."""
    model_per_period: bool
    """Whether each period has a model of its own."""
    in_order: bool = False
    """Whether one model learns the periods one after the other, in stages."""

    def period_is_input(self, spec: MethodSpec) -> bool:
        """Return True if the period is an input of the models of a method."""
        return self.tells_period and spec.period_input != "none"


STRATEGIES = {
    "joint": Strategy(tells_period=True, model_per_period=False),
    "pooled": Strategy(tells_period=False, model_per_period=False),
    "separate": Strategy(tells_period=False, model_per_period=True),
    "sequential": Strategy(tells_period=True, model_per_period=False, in_order=True),
}
"""``joint``: one model, told the period. ``pooled``: one model, the period hidden from it.
``separate``: one model per period, which sees the images and points of that period alone.
``sequential``: one model, which sees the images of one period after the other, and is told the
period if it takes one."""


def period_part(period: int) -> str:
    """Name of the part that is the model of one period."""
    return f"period-{period}"
