"""Map of changes, seen from above: a panel for each pair of periods."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from chronoscene.arrays import Array, Ints, Pixels
from chronoscene.figures import canvas
from chronoscene.figures.cloud import Cloud, shown_box
from chronoscene.figures.projections import Plane, draw_points, label_axes, readable

COLORS: Mapping[str, str] = {
    "unchanged": "#dedad2",
    "unknown": "#8c8c8c",
    "appearance": canvas.FOUR[1],
    "gone": canvas.FOUR[0],
    "new": canvas.FOUR[2],
}
"""Colours of the classes of places, which are numbered in this order."""
FAINT = 2  # Classes that the others are drawn over
WIDTH, GAP = 3.4, 0.15  # Of a panel, and between panels, in inches
LEFT, RIGHT, BOTTOM, TOP, TITLE, LINE = 0.62, 0.15, 0.5, 0.62, 0.26, 0.22


@dataclass(frozen=True, slots=True, eq=False)
class ChangePanel:
    """A pair of periods."""

    title: str
    xyz: Array
    """Places. [N, 3]"""
    classes: Ints
    """Classes of the places. [N]"""


def colors_of(classes: Ints) -> Pixels:
    """Return the colours of places by their classes. [N, 3]"""
    palette = np.array([canvas.rgb_of(color) for color in COLORS.values()])
    return palette.astype(np.uint8)[classes]


def plane_from_above(up: Array) -> Plane:
    """Choose the axes of a map: of the views along an axis, the one nearest to that from above."""
    axis = int(np.abs(up).argmax())
    right, ahead = (axis + 1) % 3, (axis + 2) % 3
    return (right, ahead) if up[axis] > 0 else (ahead, right)


def draw_changes(cloud: Cloud, panels: Sequence[ChangePanel], path: Path, *, up: Array) -> None:
    """Draw all pairs at one scale.

    Args:
        cloud: Points of the scene, which decide what part of it is shown.
        panels: The pairs.
        path: File to write; the suffix says the format.
        up: Direction that is up in the scene. [3]
    """
    box, plane = shown_box(cloud, cameras=False), plane_from_above(up)
    columns = max(min(len(panels), 3), math.ceil(math.sqrt(len(panels))))
    rows = math.ceil(len(panels) / columns)
    size = (WIDTH, WIDTH * box.edges[plane[1]] / box.edges[plane[0]])
    step = (WIDTH + GAP, size[1] + TITLE + GAP)
    width = LEFT + columns * step[0] - GAP + RIGHT
    lines = 2 if columns == 1 else 1  # of the legend
    height = BOTTOM + rows * step[1] - GAP - TITLE + TOP + (lines - 1) * LINE
    figure = canvas.new_figure(width, height)
    colors = list(COLORS.values())
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        x, y = LEFT + column * step[0], BOTTOM + (rows - 1 - row) * step[1]
        axes = figure.add_axes((x / width, y / height, size[0] / width, size[1] / height))
        for layer in (panel.classes < FAINT, panel.classes >= FAINT):
            shown = replace(cloud, xyz=panel.xyz[layer], period=panel.classes[layer])
            shown, near, names = readable(shown, box)
            draw_points(axes, shown, near, plane, size, colors, 0)
        label_axes(axes, plane, names, size)
        is_lowest = number + columns >= len(panels)
        axes.tick_params(labelbottom=is_lowest, labelleft=column == 0)
        axes.set_xlabel(names[plane[0]] if is_lowest else "", fontsize=9, labelpad=2)
        axes.set_ylabel(names[plane[1]] if column == 0 else "", fontsize=9, labelpad=2)
        axes.set_title(canvas.plain(panel.title), fontsize=9, pad=4)
    corner = (LEFT / width, 1 - 0.1 / height)
    entries = list(COLORS.items())
    in_line = math.ceil(len(entries) / lines)
    canvas.add_legend(
        figure, entries, in_line, loc="upper left", bbox_to_anchor=corner, borderpad=0
    )
    canvas.save(figure, path)
