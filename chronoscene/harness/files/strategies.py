"""Strategies: how a method is trained on the periods of a scene."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.methods import MethodSpec


@dataclass(frozen=True, slots=True)
class Strategy:
    """Differences between strategies."""

    gives_period: bool
    """True if models are given the period; else they are asked for period 0, whatever it is."""
    model_per_period: bool
    """True if each period has a model of its own."""
    in_order: bool = False
    """True if one model learns the periods one after the other, in stages."""

    def period_is_input(self, spec: MethodSpec) -> bool:
        """Return True if the models of a method are given the period."""
        return self.gives_period and spec.period_input != "none"


STRATEGIES = {
    "joint": Strategy(gives_period=True, model_per_period=False),
    "pooled": Strategy(gives_period=False, model_per_period=False),
    "separate": Strategy(gives_period=False, model_per_period=True),
    "sequential": Strategy(gives_period=True, model_per_period=False, in_order=True),
}
"""``joint``: one model, given the period. ``pooled``: one model, the period hidden from it.
``separate``: one model per period, which sees the images and points of that period alone.
``sequential``: one model, which sees the images of one period after the other, and is given the
period if it takes one."""


def period_part(period: int) -> str:
    """Name of the part that is the model of one period."""
    return f"period-{period}"
