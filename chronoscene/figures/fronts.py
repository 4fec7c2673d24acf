"""Pareto fronts: small panels of quality against cost, one row per quality."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from math import ceil, dist, exp, log
from pathlib import Path
from textwrap import fill, wrap
from typing import Any

from markupsafe import Markup

from chronoscene.figures import canvas

PANEL = (2.7, 2.3)  # Width and height in inches
PAGE_PANEL = (3.4, 2.5)  # The same for panels in pages
MAX_COLUMNS = 4
"""Panels side by side; what is more goes on below."""
LEGEND_LINE, LEGEND_COLUMN = 0.155, 4.0  # Inches
LETTERS, NOTE_LETTER = 46, 0.06  # Of a title on one line; width of one of the note in inches
MANY_TICKS = 15  # Factor between the ends of an axis from which on few of its ticks have numbers
DISC = 9.0  # Diameter in points of the discs with numbers
AXES = (155.0, 122.0)  # Width and height of the axes of a panel, about, in points
HIDDEN = 0.8  # Diameters between two discs below which one hides the number of the other
FARTHEST = 4  # Diameters by which a disc may be moved


@dataclass(frozen=True, slots=True, kw_only=True)
class Mark:
    """A configuration in a panel."""

    number: int
    """In the legend."""
    x: float
    y: float
    x_spread: float = 0.0
    y_spread: float = 0.0
    """Half lengths of the error bars."""
    on_front: bool


@dataclass(frozen=True, slots=True, kw_only=True)
class Panel:
    """Qualities against one cost."""

    title: str
    x_label: str
    y_label: str
    marks: Sequence[Mark]
    """Marks; those on the front from one end to the other, the cheapest first."""
    lower_is_better: bool
    """True if the axis of the quality is drawn downwards."""


def draw_fronts(
    rows: Sequence[Sequence[Panel]],
    path: Path,
    *,
    names: Sequence[str],
    groups: Mapping[str, Sequence[int]],
    note: str,
) -> None:
    """Draw panels, discs filled where they are on the front, with the front as steps.

    Args:
        rows: One quality of one scene each; rows may differ in length.
        path: File to write; the suffix says the format.
        names: What the numbers, from 1 on, stand for.
        groups: Numbers that share a colour, by the name of the group.
        note: Below the legend.
    """
    lines = ceil(max(len(row) for row in rows) / MAX_COLUMNS)
    columns = ceil(max(len(row) for row in rows) / lines)
    rows = [row[i : i + columns] for row in rows for i in range(0, len(row), columns)]
    per_line = max(1, int(columns * PANEL[0] / LEGEND_COLUMN))
    per_note = int(columns * PANEL[0] / NOTE_LETTER)
    note_lines = [line for part in note.split("\n") for line in wrap(part, per_note)]
    below = LEGEND_LINE * (ceil(len(names) / per_line) + len(note_lines)) + 0.3
    height = PANEL[1] * len(rows) + below
    figure = canvas.new_figure(columns * PANEL[0], height)
    figure.set_layout_engine("constrained", rect=(0, below / height, 1, 1 - below / height))
    palette = canvas.period_colors(len(groups))
    colors = {
        number: color
        for numbers, color in zip(groups.values(), palette, strict=True)
        for number in numbers
    }
    grid = figure.subplots(len(rows), columns, squeeze=False)
    for axes_row, row in zip(grid, rows, strict=True):
        for axes in axes_row[len(row) :]:
            axes.set_visible(False)
        for axes, panel in zip(axes_row, row, strict=False):
            _draw_panel(axes, panel, colors)
    _write_legend(figure, names, colors, per_line, (below - 0.12) / height)
    text = "\n".join(map(canvas.plain, note_lines))
    figure.text(0.01, 0.06 / height, text, fontsize=6.5, color=canvas.GREY, va="bottom")
    canvas.save(figure, path)


def panel_svg(panel: Panel, legend: Mapping[int, tuple[str, str]]) -> Markup:
    """Draw one panel for a page; ``legend``: name and color of each number."""
    figure = canvas.new_figure(*PAGE_PANEL, layout="constrained")
    _draw_panel(figure.add_subplot(), panel, {i: color for i, (_, color) in legend.items()})
    titles = {f"mark-{i}": name for i, (name, _) in legend.items()}
    return canvas.inline_svg(figure, f"{panel.y_label} by {panel.x_label}", titles)


def _draw_panel(axes: Any, panel: Panel, colors: Mapping[int, str]) -> None:
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    canvas.quiet_axes(axes)
    axes.set_xscale("log")
    low, high = _limits(panel.marks)
    axes.set_xlim(low, high)
    subs = (1, 3) if high > MANY_TICKS * low else (1, 1.5, 2, 3, 5, 7)
    axes.xaxis.set_major_locator(LogLocator(subs=subs))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_formatter(NullFormatter())
    axes.grid(which="major", color=canvas.GRID, linewidth=0.5)
    axes.set_title(fill(canvas.plain(panel.title), LETTERS), fontsize=7.5)
    axes.set_xlabel(canvas.plain(panel.x_label), fontsize=7.5)
    axes.set_ylabel(canvas.plain(panel.y_label), fontsize=7.5)
    axes.tick_params(labelsize=6.5)
    front = [mark for mark in panel.marks if mark.on_front]
    axes.step(
        [mark.x for mark in front],
        [mark.y for mark in front],
        where="post",
        color="#777777",
        linewidth=1.1,
        zorder=1,
    )
    shifts = _shifts(panel.marks, low, high)
    for mark in panel.marks:
        _draw_mark(axes, mark, colors[mark.number], shifts[mark.number])
    axes.margins(y=0.14)
    if panel.lower_is_better:
        axes.invert_yaxis()


def _limits(marks: Sequence[Mark]) -> tuple[float, float]:
    """Limit a logarithmic axis: margins at both ends, and at least a factor of two between them."""
    low = min(max(mark.x - mark.x_spread, mark.x / 2) for mark in marks)
    high = max(mark.x + mark.x_spread for mark in marks)
    margin = max(0.14 * log(high / low), (log(2) - log(high / low)) / 2)
    return low / exp(margin), high * exp(margin)


def _shifts(marks: Sequence[Mark], low: float, high: float) -> dict[int, float]:
    """Move discs that would hide others to the side of them, in points, by the number.

    Those on the front stay first. ``low`` and ``high``: limits of the axis of the costs.
    """
    ends = [mark.y + side * mark.y_spread for mark in marks for side in (-1, 1)]
    width, height = AXES[0] / log(high / low), AXES[1] / max(1.28 * (max(ends) - min(ends)), 1e-9)
    shifts: dict[int, float] = {}
    taken: list[tuple[float, float]] = []
    for mark in sorted(marks, key=lambda mark: not mark.on_front):
        x, y = width * log(mark.x / low), height * mark.y
        shifts[mark.number] = 0.0
        for steps in sorted(range(-FARTHEST, FARTHEST + 1), key=abs):
            place = (x + DISC * steps, y)
            clear = all(dist(place, other) >= HIDDEN * DISC for other in taken)
            if clear and 0 <= place[0] <= AXES[0]:
                shifts[mark.number] = DISC * steps
                break
        taken.append((x + shifts[mark.number], y))
    return shifts


def _draw_mark(axes: Any, mark: Mark, color: str, shift: float) -> None:
    """Draw a disc with its number; white with a coloured rim off the front."""
    from matplotlib.transforms import ScaledTranslation

    there = ScaledTranslation(shift / 72, 0, axes.figure.dpi_scale_trans)
    face = color if mark.on_front else "white"
    # Those on the front lie above the others, and each disc with its number above the one before.
    level = 2 + mark.on_front + mark.number / 1e4
    axes.errorbar(
        mark.x,
        mark.y,
        xerr=mark.x_spread,
        yerr=mark.y_spread,
        color=color,
        linewidth=0.8,
        zorder=level,
    )
    style = {"markerfacecolor": face, "markeredgecolor": color, "markeredgewidth": 0.9}
    axes.plot(
        mark.x,
        mark.y,
        "o",
        markersize=DISC,
        zorder=level,
        gid=f"mark-{mark.number}",
        transform=axes.transData + there,
        **style,
    )
    axes.annotate(
        str(mark.number),
        (mark.x, mark.y),
        xytext=(shift, 0),
        textcoords="offset points",
        ha="center",
        va="center_baseline",
        fontsize=6,
        color=_ink(face),
        zorder=level,
    )


def _ink(ground: str) -> str:
    """Choose black or white, whichever is read more easily on a colour."""
    if ground == "white":
        return "black"
    luma = float(canvas.rgb_of(ground) @ (0.299, 0.587, 0.114))
    return "black" if luma > 140 else "white"


def _write_legend(
    figure: Any, names: Sequence[str], colors: Mapping[int, str], columns: int, top: float
) -> None:
    from matplotlib.lines import Line2D

    figure.legend(
        [Line2D([], [], linestyle="", marker="o", color=colors[i + 1]) for i in range(len(names))],
        [f"{i + 1}  {canvas.plain(name)}" for i, name in enumerate(names)],
        loc="upper left",
        bbox_to_anchor=(0.005, top),
        ncols=columns,
        fontsize=7,
        frameon=False,
        borderaxespad=0,
        handletextpad=0.2,
        columnspacing=1.5,
    )
