"""What happens when: states per period of sites, renewals, looks, trees."""

from __future__ import annotations

import numpy as np

SITE = ("lot", "foundation", "frame_low", "frame_high", "finished")


def site_stages(periods: int) -> list[str]:
    """Stages of a building site: always from the empty lot to the finished building.

    Three periods show lot, frame, finished; a single period shows the finished building.
    """
    if periods == 1:
        return ["finished"]
    if periods == 3:
        return ["lot", "frame_high", "finished"]
    steps = np.linspace(0, len(SITE) - 1, min(periods, len(SITE)))
    stages = [SITE[int(np.floor(s + 0.5))] for s in steps]
    return stages + ["finished"] * (periods - len(stages))


def renewal_stages(periods: int) -> list[str]:
    """A house that stands, falls, and leaves room for a car park."""
    if periods == 1:
        return ["house"]
    fall = 1 if periods < 4 else 2
    after = ["rubble", *["park"] * periods] if periods > 2 else ["park"]
    return (["house"] * fall + after)[:periods]


def looks(rng: np.random.Generator, periods: int, chance: float) -> list[int]:
    """Number of the look of a facade per period; with a chance of one change."""
    states = [0] * periods
    if periods > 1 and rng.random() < chance:
        change = int(rng.integers(1, periods))
        states[change:] = [1] * (periods - change)
    return states


def tree_heights(rng: np.random.Generator, periods: int, start: float) -> list[float | None]:
    """Height per period: 20 to 60 % more in the end; some are planted late, some are felled."""
    growth = float(rng.uniform(1.2, 1.6)) ** (1 / max(periods - 1, 1))
    heights: list[float | None] = [round(start * growth**p, 2) for p in range(periods)]
    fate = rng.random()
    if periods > 1 and fate < 0.2:
        change = int(rng.integers(1, periods))
        if fate < 0.1:
            heights[:change] = [None] * change
        else:
            heights[change:] = [None] * (periods - change)
    return heights


def visits(rng: np.random.Generator, periods: int, chance: float) -> list[bool]:
    """Whether something movable is there, per period."""
    return [bool(x) for x in rng.random(periods) < chance]
