"""Stacked bars: images and points of all scenes by period."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from chronoscene.figures import canvas
from chronoscene.statistics.counts import SceneCount, period_title

BAR = 0.3  # Inches per scene
WIDTH = 9.0
LINE = 0.24  # Inches per line of the legend
MAX_LEGEND_ENTRIES = 12  # Periods up to which each has an entry


def draw_bars(counts: Sequence[SceneCount], path: Path) -> None:
    """Draw the counts of scenes, first scene on top.

    Args:
        counts: One per scene.
        path: File to write; the suffix says the format.
    """
    from rich.cells import cell_len

    periods = max(len(c.periods) for c in counts)
    colors = canvas.period_colors(periods)
    names = [canvas.short_name(c.name) for c in counts]
    longest = max(map(cell_len, names))
    seen = any(c.count == "seen" for c in counts)
    legend = list(zip(_period_names(counts, periods), colors, strict=True))
    legend = legend[:: -(-periods // MAX_LEGEND_ENTRIES)]
    points = [[p.points for p in c.periods] for c in counts]
    if any(c.points_without_period for c in counts):
        for row, c in zip(points, counts, strict=True):
            row += [0] * (periods - len(row)) + [c.points_without_period]
        legend.append((canvas.UNSEEN, canvas.UNSEEN_COLOR))
        colors = [*colors, canvas.UNSEEN_COLOR]
    columns = max(1, int((WIDTH - 0.3) / (0.45 + 0.075 * max(len(name) for name, _ in legend))))
    left, bottom = 0.25 + 0.075 * longest, 0.5
    top = 0.18 + LINE * -(-len(legend) // columns)
    height = top + bottom + BAR * (len(counts) + 0.4)
    figure = canvas.new_figure(WIDTH, height)
    gap = 0.35
    width = (WIDTH - left - gap - 0.2) / 2
    kinds = (
        ("images", [[p.images for p in c.periods] for c in counts]),
        ("points, again in each period" if seen else "points", points),
    )
    for i, (what, values) in enumerate(kinds):
        box = (left + i * (width + gap), bottom, width, height - top - bottom)
        axes = figure.add_axes((box[0] / WIDTH, box[1] / height, box[2] / WIDTH, box[3] / height))
        _draw_panel(axes, what, values, colors)
        axes.set_yticks(range(len(counts)), [] if i else map(canvas.plain, names))
        axes.tick_params(axis="y", length=0, labelsize=9)
    place = (0.5, 1 - 0.1 / height)
    canvas.add_legend(figure, legend, columns, loc="upper center", bbox_to_anchor=place)
    canvas.save(figure, path)


def _draw_panel(
    axes: Any, what: str, values: Sequence[Sequence[int]], colors: Sequence[str]
) -> None:
    """Draw one bar per scene, its periods side by side, with their sum at the end."""
    canvas.quiet_axes(axes)
    for side in ("top", "right", "left"):
        axes.spines[side].set_visible(False)
    axes.grid(axis="x", color=canvas.GRID, linewidth=0.6)
    sums = [sum(row) for row in values]
    for p, color in enumerate(colors):
        rows = [y for y, row in enumerate(values) if p < len(row) and row[p]]
        axes.barh(
            rows,
            [values[y][p] for y in rows],
            left=[sum(values[y][:p]) for y in rows],
            height=0.72,
            color=color,
            edgecolor="white",
            linewidth=0.5,
        )
    largest = max(sums, default=0) or 1
    for y, total in enumerate(sums):
        text = axes.text(total + 0.012 * largest, y, f"{total:,}", va="center", fontsize=8)
        text.set(color=canvas.GREY, bbox={"color": "white", "pad": 0.8})
    axes.set_xlim(0, 1.17 * largest)
    axes.set_ylim(len(values) - 0.45, -0.55)
    axes.locator_params(axis="x", nbins=6, integer=True)
    axes.xaxis.set_major_formatter(_short(largest))
    axes.set_xlabel(f"{what}, {sum(sums):,} in all", fontsize=9)


def _short(largest: int) -> Callable[[float, int], str]:
    """Return the formatter of an axis, with one unit for all numbers."""
    for size, sign in ((1_000_000, "M"), (10_000, "k")):
        if largest >= size:
            unit = 1000 if sign == "k" else size
            return lambda value, _: f"{value / unit:,g}{sign}" if value else "0"
    return lambda value, _: f"{value:,.0f}"


def _period_names(counts: Sequence[SceneCount], periods: int) -> list[str]:
    """Name the periods in the legend: by their titles if those are equal in all scenes."""
    names = []
    for i in range(periods):
        titles = {period_title(i, p.label, p.date) for c in counts for p in c.periods if p.id == i}
        names.append(titles.pop() if len(titles) == 1 else str(i))
    if all(name == str(i) for i, name in enumerate(names)):
        return [f"Period {i}" if i == 0 or periods < 7 else str(i) for i in range(periods)]
    return [canvas.short_name(name) for name in names]
