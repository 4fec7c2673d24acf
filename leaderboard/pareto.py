"""Plots of quality against cost for the page of a scene."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from chronoscene.figures.fronts import Mark, Panel, panel_svg
from chronoscene.harness.report.tradeoff import on_front
from chronoscene.metrics.registry import metric_info

LEAST_RATIO = 1.1
"""Smallest ratio of the largest cost to the smallest one in a plot."""


class Point(NamedTuple):
    """A method: its number in the legend, its cost and its quality."""

    number: int
    cost: float
    quality: float


def plot(
    points: Sequence[Point],
    legend: Mapping[int, tuple[str, str]],
    *,
    cost: str,
    metric: str,
    tolerance: float = 0.0,
) -> Markup | None:
    """Draw methods and the front of those to which none is superior.

    Args:
        points: Their cost is on a logarithmic axis; those that cost nothing are left out.
        legend: Name and colour of each number.
        cost: Name of the horizontal axis.
        metric: Metric of the vertical axis.
        tolerance: Share by which costs may differ and still be equal.

    Returns:
        None where all cost much the same, as under a budget of time.
    """
    points = sorted((p for p in points if p.cost > 0), key=lambda p: p.cost)
    if not points or points[-1].cost < LEAST_RATIO * points[0].cost:
        return None
    info = metric_info(metric)
    costs, quality = np.array([[p.cost, p.quality] for p in points]).T
    signed = quality if info.higher_is_better else -quality
    best = on_front(costs, signed, tolerance).tolist()
    marks = [
        Mark(number=p.number, x=p.cost, y=p.quality, on_front=is_best)
        for p, is_best in zip(points, best, strict=True)
    ]
    panel = Panel(
        title="",
        x_label=cost,
        y_label=info.title,
        marks=marks,
        lower_is_better=not info.higher_is_better,
    )
    return panel_svg(panel, legend)
