"""A plot of quality against cost, as coordinates for an SVG picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from chronoscene.bench.tradeoff import on_front

WIDTH, HEIGHT = 440, 300
LEFT, RIGHT, TOP, BOTTOM = 52, 16, 14, 44
"""Space for the axes around the plot."""


LEAST_RATIO = 1.1
"""Of the largest cost and the smallest one in a plot."""


class Point(NamedTuple):
    """A method: what it costs, and what it reaches; more is better."""

    label: str
    cost: float
    quality: float


def plot(points: Sequence[Point], *, cost: str, quality: str) -> dict[str, Any] | None:
    """What the template draws; None where all cost much the same, as under a budget of time.

    Args:
        points: Their cost is on a logarithmic axis; those that cost nothing are left out.
        cost: Name of the horizontal axis.
        quality: Name of the vertical axis.
    """
    points = [point for point in points if point.cost > 0]
    logs = [math.log10(p.cost) for p in points]
    if not points or max(logs) - min(logs) < math.log10(LEAST_RATIO):
        return None
    low, high = min(logs) - 0.12, max(logs) + 0.12
    values = [p.quality for p in points]
    margin = 0.1 * (max(values) - min(values)) or 0.5
    bottom, top = min(values) - margin, max(values) + margin

    def x(value: float) -> float:
        return round(LEFT + (math.log10(value) - low) / (high - low) * (WIDTH - LEFT - RIGHT), 1)

    def y(value: float) -> float:
        return round(TOP + (top - value) / (top - bottom) * (HEIGHT - TOP - BOTTOM), 1)

    heights = _label_heights([y(value) for value in values])
    best = on_front(np.array([p.cost for p in points]), np.array(values)).tolist()
    front = sorted(compress(points, best), key=lambda p: p.cost)
    corners = [f"M{x(front[0].cost)} {y(front[0].quality)}"]
    corners += [f"H{x(p.cost)} V{y(p.quality)}" for p in front[1:]]
    return {
        "size": (WIDTH, HEIGHT),
        "box": (LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM),
        "cost": cost,
        "quality": quality,
        "front": f"{' '.join(corners)} H{WIDTH - RIGHT}",
        "points": [
            {
                "label": p.label,
                "x": x(p.cost),
                "y": y(p.quality),
                "height": height,
                "best": is_best,
                "left": x(p.cost) > WIDTH / 2,
            }
            for p, height, is_best in zip(points, heights, best, strict=True)
        ],
        "across": [(x(tick), f"{tick:g}") for tick in _log_ticks(10**low, 10**high)],
        "up": [(y(tick), f"{tick:g}") for tick in _ticks(bottom, top)],
    }


def _label_heights(heights: Sequence[float]) -> list[float]:
    """Heights of labels near those of their points, a line of text apart at least."""
    found = [0.0] * len(heights)
    highest = math.inf
    for i in sorted(range(len(heights)), key=lambda i: -heights[i]):  # from the bottom up
        found[i] = highest = min(heights[i] - 6, highest - 13)
    return found


def _log_ticks(low: float, high: float) -> list[float]:
    """Round values between two positive ones: 1, 2, 5, 10, ..., or finer where these are few."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**k for k in powers for m in (1, 2, 5) if low <= m * 10.0**k <= high]
    return ticks if len(ticks) > 1 else _ticks(low, high)


def _ticks(low: float, high: float) -> list[float]:
    """About five round values between two."""
    step = 10.0 ** math.floor(math.log10((high - low) / 4))
    step *= max(m for m in (1, 2, 5) if m * step <= (high - low) / 3 or m == 1)
    return [k * step for k in range(math.ceil(low / step), math.floor(high / step) + 1)]
