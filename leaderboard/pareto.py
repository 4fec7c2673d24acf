"""A plot of quality against cost, as coordinates for an SVG picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import compress
from typing import Any, NamedTuple

import numpy as np

from chronoscene.bench.report.tradeoff import on_front

WIDTH, HEIGHT = 440, 300
LEFT, RIGHT, TOP, BOTTOM = 52, 16, 14, 44
"""Space for the axes around the plot."""

CHARACTER = 7.0  # Mean width of one in a label

Box = tuple[float, float, float, float]  # Left, top, right, bottom

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

    labels = _place_labels([(x(p.cost), y(p.quality), p.label) for p in points])
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
                "best": is_best,
                "label_x": label[0],
                "label_y": label[1],
                "anchor": label[2],
            }
            for p, label, is_best in zip(points, labels, best, strict=True)
        ],
        "across": [(x(tick), f"{tick:g}") for tick in _log_ticks(10**low, 10**high)],
        "up": [(y(tick), f"{tick:g}") for tick in _ticks(bottom, top)],
    }


def _place_labels(points: Sequence[tuple[float, float, str]]) -> list[tuple[float, float, str]]:
    """Where labels begin, are centred or end: beside their points, above or below, where they
    cover least of points, of labels before them and of what is outside the plot."""
    inside = (LEFT, TOP, WIDTH - RIGHT, HEIGHT - BOTTOM)
    boxes = [(x - 5, y - 5, x + 5, y + 5) for x, y, _ in points]
    found = {}
    for i in sorted(range(len(points)), key=lambda i: -len(points[i][2])):
        x, y, label = points[i]
        width = CHARACTER * len(label)
        places = []
        beside = [(x + 9, y + 4, "start"), (x - 9 - width, y + 4, "end")]
        around = [
            (x + move - share * width, height, anchor)
            for height in (y - 9, y + 18, y - 23, y + 32)
            for anchor, share, move in (("middle", 0.5, 0), ("start", 0, 4), ("end", 1, -4))
        ]
        for left, height, anchor in (around[0], *beside, *around[1:]):
            box = (left, height - 11, left + width, height + 2)
            covered = sum(_overlap(box, other) for other in boxes)
            covered += width * 13 - _overlap(box, inside)
            at = {"start": left, "middle": x, "end": left + width}[anchor]
            places.append((covered, (round(at, 1), height, anchor), box))
        _, place, box = min(places, key=lambda p: p[0])
        found[i] = place
        boxes.append(box)
    return [found[i] for i in range(len(points))]


def _overlap(a: Box, b: Box) -> float:
    """Area that two boxes share."""
    across, up = min(a[2], b[2]) - max(a[0], b[0]), min(a[3], b[3]) - max(a[1], b[1])
    return max(across, 0.0) * max(up, 0.0)


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
