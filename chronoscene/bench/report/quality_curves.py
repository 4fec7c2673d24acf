"""Quality against training time, as lines of an SVG that pages draw in their own colours."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from chronoscene.bench.files.records import RunRecord
from chronoscene.bench.report.summary import kind_of
from chronoscene.bench.report.time_to_quality import read_curve

WIDTH, HEIGHT = 640.0, 340.0
"""Of the drawing, in its units."""
LEFT, BOTTOM, TOP, RIGHT = 64.0, 68.0, 36.0, 24.0  # Margins, for what is written at the axes
COLORS = ("#3f8fd2", "#e07b1a", "#2e9e5b", "#d3504f", "#9a70c8", "#a07a3c", "#d868a8", "#3aa6b0")
"""Of the lines; they are seen on white and on black."""
DASHES = ("", "8 4", "2 4", "8 4 2 4")
"""For the lines after the last colour, which begin again with the first."""


@dataclass(frozen=True, slots=True)
class Line:
    """The probes of one model."""

    method: str
    color: str
    dash: str
    points: tuple[tuple[float, float, str], ...]
    """x, y and the values in words."""


@dataclass(frozen=True, slots=True)
class Curves:
    """A drawing; places are in its units."""

    lines: tuple[Line, ...]
    x_ticks: tuple[tuple[float, str], ...]
    y_ticks: tuple[tuple[float, str], ...]

    @property
    def methods(self) -> dict[str, tuple[str, str]]:
        """Colour and dash of each method."""
        return {line.method: (line.color, line.dash) for line in self.lines}


def draw_curves(records: Sequence[RunRecord]) -> Curves | None:
    """PSNR of the probe views against seconds of training, from ``curve.csv`` of some runs.

    A run has a line for each of its models, whose seconds are its own.

    Args:
        records: Runs on one scene, as from `chronoscene.bench.report.summary.read_runs`.

    Returns:
        None if nothing was probed.
    """
    from matplotlib.ticker import MaxNLocator

    probes = [
        (i, record, model, points)
        for i, record in enumerate(records)
        for model, points in _read(record.folder).items()
    ]
    if not probes:
        return None
    values = [point for *_, points in probes for point in points]
    x_ticks = MaxNLocator(5).tick_values(0.0, max(x for x, _ in values))
    y_ticks = MaxNLocator(5).tick_values(min(y for _, y in values), max(y for _, y in values))

    def place(x: float, y: float) -> tuple[float, float]:
        across = (x - x_ticks[0]) / (x_ticks[-1] - x_ticks[0])
        up = (y - y_ticks[0]) / (y_ticks[-1] - y_ticks[0])
        inner = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM
        return round(LEFT + across * inner[0], 1), round(TOP + (1 - up) * inner[1], 1)

    lines = []
    for i, record, model, points in probes:
        method = f"{record.title} ({kind_of(record)})"
        what = method if model == "all" else f"{method}, {model}"
        spots = [(*place(x, y), f"{what}: {y:.2f} dB at {x:.1f} s") for x, y in points]
        turn, color = divmod(i, len(COLORS))
        lines.append(Line(method, COLORS[color], DASHES[turn % len(DASHES)], tuple(spots)))
    return Curves(
        tuple(lines),
        tuple((place(x, y_ticks[0])[0], f"{x:g}") for x in x_ticks),
        tuple((place(x_ticks[0], y)[1], f"{y:g}") for y in y_ticks),
    )


def _read(folder: Path) -> dict[str, list[tuple[float, float]]]:
    """Seconds and PSNR of each model; none where another program made the images."""
    models: dict[str, list[tuple[float, float]]] = {}
    for point in read_curve(folder):
        if math.isfinite(point.psnr):
            models.setdefault(point.model, []).append((point.seconds, point.psnr))
    return models
