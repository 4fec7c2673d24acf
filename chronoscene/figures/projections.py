"""The points of a scene projected on XY, XZ and YZ at one scale, coloured by period.

The panels stand as in a technical drawing: XZ below XY on the same x axis, YZ beside XY on the same
y axis, and the corner that is left says how much is shown.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np

from chronoscene.figures import canvas
from chronoscene.figures.canvas import DPI
from chronoscene.figures.cloud import Box, Cloud, shown_box
from chronoscene.figures.density_map import Window, count_points, dot_radius, grow_dots, shade

Plane = tuple[int, int]
"""Axes of the world along width and height of a panel."""
Size = tuple[float, float]
"""Width and height in inches."""

CELL = 2
"""Pixels along each side of a cell of the density where dots are not larger than a cell: the colour
of a single pixel can hardly be seen."""
DRAWING = (7.6, 7.0)  # Largest width and height in inches of the panels and the gap between them
GAP = 0.12
LEFT, RIGHT, BOTTOM = 0.62, 0.15, 0.5
TITLE, LINE = 0.4, 0.24  # Height in inches of the title and of each line of the legend
MIN_WIDTH = 3.5
BEHIND = 0.7  # Strength of the points where cameras are drawn, too
PATCH = 16  # Pixels along each side of the squares by which the area with points is measured
PLAIN = (0.1, 10_000.0)  # Longest edges for which coordinates are written as they are
FAR = 20.0
"""Times the longest edge: coordinates beyond would be numbers with more digits than differ."""
AXES = "xyz"


def draw_cloud(cloud: Cloud, path: Path, *, cameras: bool = False) -> None:
    """Draw the three projections of a scene.

    Args:
        cloud: Points and cameras of the scene.
        path: File to write; the suffix says the format.
        cameras: Whether to draw the cameras, too, with their viewing directions.
    """
    cloud, box, axis_names = readable(cloud, shown_box(cloud, cameras=cameras))
    period, colors = cloud.groups()
    cloud = replace(cloud, period=period)
    dx, dy, dz = box.edges
    scale = min((DRAWING[0] - GAP) / (dx + dz), (DRAWING[1] - GAP) / (dy + dz))
    width = max(LEFT + (dx + dz) * scale + GAP + RIGHT, MIN_WIDTH)
    names = legend_names(cloud.labels)
    names += [canvas.UNSEEN] * (len(colors) - len(names))
    columns = max(1, int((width - LEFT) / (0.42 + 0.075 * max(map(len, names)))))
    top = TITLE + LINE * -(-len(names) // columns)
    height = BOTTOM + (dz + dy) * scale + GAP + top
    figure = canvas.new_figure(width, height)
    x_right, y_top = LEFT + dx * scale + GAP, BOTTOM + dz * scale + GAP
    places = {(0, 1): (LEFT, y_top), (0, 2): (LEFT, BOTTOM), (2, 1): (x_right, y_top)}
    dots = _dot_radius(cloud, box, scale, places)
    for plane, (x, y) in places.items():
        size = (box.edges[plane[0]] * scale, box.edges[plane[1]] * scale)
        axes = figure.add_axes((x / width, y / height, size[0] / width, size[1] / height))
        image = draw_points(axes, cloud, box, plane, size, colors, dots)
        if cameras:
            image.set_alpha(BEHIND)
            _draw_cameras(axes, cloud, box, plane, colors)
        label_axes(axes, plane, axis_names, size)
    _write_texts(figure, cloud, box, (x_right / width, (y_top - GAP) / height))
    entries, corner = list(zip(names, colors, strict=True)), (LEFT / width, 1 - TITLE / height)
    canvas.add_legend(
        figure, entries, columns, loc="upper left", bbox_to_anchor=corner, borderpad=0
    )
    canvas.save(figure, path)


def readable(cloud: Cloud, box: Box) -> tuple[Cloud, Box, tuple[str, ...]]:
    """Express cloud and box in numbers that fit beside an axis, and name the axes accordingly.

    Places far from the origin are moved, and very small or large scenes scaled.
    """
    edge = float(box.edges.max())
    digits = np.log10(edge)
    far = np.maximum(np.abs(box.low), np.abs(box.high)) > FAR * edge
    step = 10.0 ** np.ceil(digits)
    offset = np.where(far, np.round((box.low + box.high) / 2 / step) * step, 0.0)
    power = 0 if PLAIN[0] <= edge < PLAIN[1] else 3 * int(np.floor(digits / 3))
    if cloud.unit == "metre":
        power = max(-3, min(3, power))
    factor = 10.0**power
    xyz, centres = (cloud.xyz - offset) / factor, (cloud.centres - offset) / factor
    box = Box((box.low - offset) / factor, (box.high - offset) / factor)
    units = {-3: " [mm]", 0: " [m]", 3: " [km]"}
    unit = units[power] if cloud.unit == "metre" else f" [$10^{{{power}}}$]" if power else ""
    # In the unit of the axis, like its numbers.
    taken = [f" {'-' if x > 0 else '+'} {abs(x):,.12g}" if x else "" for x in offset / factor]
    names = tuple(f"{axis}{shift}{unit}" for axis, shift in zip(AXES, taken, strict=True))
    return replace(cloud, xyz=xyz, centres=centres), box, names


def legend_names(labels: Sequence[str]) -> list[str]:
    """Name the periods in the legend."""
    if all(label == str(i) for i, label in enumerate(labels)):
        return [f"Period {i}" if len(labels) <= 8 else str(i) for i in range(len(labels))]
    names = [label if label == str(i) else f"{i}: {label}" for i, label in enumerate(labels)]
    return [canvas.short_name(name) for name in names]


def _dot_radius(cloud: Cloud, box: Box, scale: float, planes: Iterable[Plane]) -> int:
    """Choose the radius of the dots in pixels by the occupied area of the median panel."""
    shown = cloud.xyz[box.holds(cloud.xyz)]
    if not len(shown):
        return 0
    cells = np.floor((shown - box.low) * (scale * DPI / PATCH)).astype(np.int64)
    side = int(max(DRAWING) * DPI / PATCH) + 2
    areas = [np.count_nonzero(np.bincount(cells[:, i] * side + cells[:, j])) for i, j in planes]
    return dot_radius(len(shown), PATCH**2 * int(np.median(areas)))


def draw_points(
    axes: Any, cloud: Cloud, box: Box, plane: Plane, size: Size, colors: Sequence[str], dots: int
) -> Any:
    """Draw the density of the points, as an image. ``dots``: their radius in pixels."""
    canvas.quiet_axes(axes)
    dpi = DPI if dots else DPI / CELL
    pixels = [max(1, round(edge * dpi)) for edge in size]
    low, high = box.low[list(plane)], box.high[list(plane)]
    window = Window((low[0], low[1]), (high[0], high[1]), pixels[0], pixels[1])
    counts = count_points(cloud.xyz[:, plane], cloud.period, len(colors), window)
    image = shade(grow_dots(counts, dots), colors)
    extent = (low[0], high[0], low[1], high[1])
    axes.grid(color=canvas.GRID, linewidth=0.5, zorder=0)
    return axes.imshow(image, extent=extent, interpolation="nearest", aspect="auto", zorder=1)


def _draw_cameras(axes: Any, cloud: Cloud, box: Box, plane: Plane, colors: Sequence[str]) -> None:
    """Draw a dot with a line in the viewing direction for each camera, on white."""
    from matplotlib.collections import LineCollection

    crowd = float(np.clip((300 / len(cloud.centres)) ** 0.5, 0.4, 1.0))
    length = 0.02 * crowd * float(box.edges.max())
    centres = cloud.centres[:, plane]
    ends = centres + length * cloud.directions[:, plane]
    own = [colors[p] for p in cloud.camera_period]
    views = list(np.stack([centres, ends], axis=1))
    size = float(np.clip(1500 / len(centres), 3.0, 9.0))
    for color, wide in (("white", 1.8), ("#333333", 0.6)):
        lines = LineCollection(views, colors=color, linewidths=crowd * wide, zorder=2)
        axes.add_collection(lines, autolim=False)
    axes.scatter(*centres.T, s=2.2 * size, c="white", linewidths=0, zorder=3)
    axes.scatter(*centres.T, s=size, c=own, edgecolors="#333333", linewidths=0.3, zorder=3)


def label_axes(axes: Any, plane: Plane, names: Sequence[str], size: Size) -> None:
    """Put ticks and names on the outer sides; panels that share an axis name it once.

    There are as many ticks as fit.
    """
    from matplotlib.ticker import FuncFormatter, MaxNLocator

    for axis, edge, each in ((axes.xaxis, size[0], 0.55), (axes.yaxis, size[1], 0.35)):
        most = int(np.clip(edge / each, 1, 6))
        axis.set_major_locator(MaxNLocator(most, steps=[1, 2, 2.5, 5, 10]))
        axis.set_major_formatter(FuncFormatter(_number))
    axes.tick_params(labelbottom=plane != (0, 1), labelleft=plane[0] == 0)
    if plane != (0, 1):
        axes.set_xlabel(names[plane[0]], fontsize=9, labelpad=2)
    if plane[0] == 0:
        axes.set_ylabel(names[plane[1]], fontsize=9, labelpad=2)
    title = "".join(sorted(AXES[i] for i in plane)).upper()
    box = {"color": "white", "alpha": 0.8, "pad": 1.5, "linewidth": 0}
    style = {"fontsize": 8, "weight": "bold", "color": canvas.GREY, "bbox": box, "zorder": 4}
    at = {"xy": (0, 1), "xycoords": "axes fraction", "textcoords": "offset points"}
    axes.annotate(title, xytext=(4, -4), va="top", **at, **style)


def _number(value: float, _: int) -> str:
    return f"{round(value, 9):,.10g}".replace("-", "\N{MINUS SIGN}")


def _write_texts(figure: Any, cloud: Cloud, box: Box, corner: tuple[float, float]) -> None:
    """Write the title, and the numbers of points and cameras in the corner."""
    width, height = figure.get_size_inches()
    left, top = LEFT / width, 1 - 0.1 / height
    longest = int((width - LEFT) / 0.095)
    name = shorten(cloud.name, longest, placeholder="...") or cloud.name[:longest]
    figure.text(left, top, canvas.plain(name), fontsize=11, va="top")
    outside = int((~box.holds(cloud.xyz)).sum())
    lines = [f"{len(cloud.xyz):,} points", f"{len(cloud.centres):,} cameras"]
    if outside:
        lines.insert(1, f"{outside:,} outside")
    at = corner[0], corner[1] - 0.42 / height
    figure.text(*at, "\n".join(lines), fontsize=8, va="top", color=canvas.GREY, linespacing=1.4)
