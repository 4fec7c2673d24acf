"""The points of a scene projected on XY, XZ and YZ at one scale, coloured by period.

The panels stand as in a technical drawing: XZ below XY on the same x axis, YZ beside XY on the same
y axis, and the corner that is left says how much is shown.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import shorten
from typing import Any

import numpy as np
from numpy.typing import NDArray

from chronoscene.figures.canvas import DPI, GREY, GRID, new_figure, quiet_axes, save
from chronoscene.figures.cloud import Box, Cloud, cloud_of, shown_box
from chronoscene.figures.colors import period_colors
from chronoscene.figures.density import Window, count_points, dot_radius, grow_dots, shade
from chronoscene.scene import Scene

Array = NDArray[np.float64]

CELL = 2
"""Pixels along each side of a cell of the density where dots are not larger than a cell: the colour
of a single pixel can hardly be seen."""
DRAWING = (7.6, 7.0)
"""Largest width and height in inches of the panels and the gap between them."""
GAP = 0.12
LEFT, RIGHT, BOTTOM = 0.62, 0.15, 0.5
TITLE, LINE = 0.4, 0.24
"""Height in inches of the title and of each line of the legend."""
LEAST_WIDTH = 3.5
AXES = "xyz"


def draw_projections(scene: Scene, path: Path, *, cameras: bool = False) -> None:
    """Draw the three projections of a scene.

    Args:
        scene: The scene.
        path: File to write; the suffix says the format.
        cameras: Whether to draw the cameras, too, with their viewing directions.
    """
    draw_cloud(cloud_of(scene), path, cameras=cameras)


def draw_cloud(cloud: Cloud, path: Path, *, cameras: bool = False) -> None:
    """Draw points and cameras; see `draw_projections`."""
    box = shown_box(cloud, cameras=cameras)
    dx, dy, dz = box.edges
    scale = min((DRAWING[0] - GAP) / (dx + dz), (DRAWING[1] - GAP) / (dy + dz))
    width = max(LEFT + (dx + dz) * scale + GAP + RIGHT, LEAST_WIDTH)
    names = legend_names(cloud.labels)
    columns = max(1, int((width - LEFT) / (0.42 + 0.075 * max(map(len, names)))))
    top = TITLE + LINE * -(-len(names) // columns)
    height = BOTTOM + (dz + dy) * scale + GAP + top
    figure = new_figure(width, height)
    colors = period_colors(len(names))
    dots = dot_radius(int((cloud.period >= 0).sum()), int(DPI**2 * DRAWING[0] * DRAWING[1] / 3))
    x_right, y_top = LEFT + dx * scale + GAP, BOTTOM + dz * scale + GAP
    places = {(0, 1): (LEFT, y_top), (0, 2): (LEFT, BOTTOM), (2, 1): (x_right, y_top)}
    for plane, (x, y) in places.items():
        size = (box.edges[plane[0]] * scale, box.edges[plane[1]] * scale)
        place = (x / width, y / height, size[0] / width, size[1] / height)
        axes = figure.add_axes(place)
        _draw_points(axes, cloud, box, plane, size, colors, dots)
        if cameras:
            _draw_cameras(axes, cloud, box, plane, colors)
        _label_axes(axes, plane, cloud.unit)
    _write_texts(figure, cloud, box, (x_right / width, (y_top - GAP) / height))
    _draw_legend(figure, names, colors, columns, 1 - TITLE / height)
    save(figure, path)


def legend_names(labels: Sequence[str]) -> list[str]:
    """What the legend calls the periods."""
    bare = all(label == str(i) for i, label in enumerate(labels))
    if bare:
        return [f"Period {i}" if len(labels) <= 8 else str(i) for i in range(len(labels))]
    names = [label if label == str(i) else f"{i}: {label}" for i, label in enumerate(labels)]
    return [shorten(name, 28, placeholder="...") or name[:28] for name in names]


def _draw_points(
    axes: Any,
    cloud: Cloud,
    box: Box,
    plane: tuple[int, int],
    size: tuple[float, float],
    colors: Sequence[str],
    dots: int,
) -> None:
    """The density of the points. ``dots``: their radius in pixels."""
    quiet_axes(axes)
    dpi = DPI if dots else DPI / CELL
    pixels = [max(1, round(edge * dpi)) for edge in size]
    low, high = box.low[list(plane)], box.high[list(plane)]
    window = Window((low[0], low[1]), (high[0], high[1]), pixels[0], pixels[1])
    counts = count_points(cloud.xyz[:, plane], cloud.period, len(colors), window)
    image = shade(grow_dots(counts, dots), colors)
    extent = (low[0], high[0], low[1], high[1])
    axes.imshow(image, extent=extent, interpolation="nearest", aspect="auto", zorder=1)
    axes.grid(color=GRID, linewidth=0.5, zorder=0)


def _draw_cameras(
    axes: Any, cloud: Cloud, box: Box, plane: tuple[int, int], colors: Sequence[str]
) -> None:
    """A dot with a line in the viewing direction for each camera."""
    from matplotlib.collections import LineCollection

    length = 0.02 * float(box.edges.max())
    centres = cloud.centres[:, plane]
    ends = centres + length * cloud.directions[:, plane]
    own = [colors[p] for p in cloud.camera_period]
    lines = LineCollection(list(np.stack([centres, ends], axis=1)), colors="#222222")
    lines.set(linewidth=0.4, zorder=2)
    axes.add_collection(lines, autolim=False)
    area = float(np.clip(1500 / len(centres), 2.0, 8.0))
    axes.scatter(*centres.T, s=area, c=own, edgecolors="#222222", linewidths=0.3, zorder=3)


def _label_axes(axes: Any, plane: tuple[int, int], unit: str) -> None:
    """Ticks and names on the outer sides; panels that share an axis name it once."""
    names = [f"{AXES[i]} [m]" if unit == "metre" else AXES[i] for i in plane]
    axes.locator_params(nbins=6 if plane[0] == 0 else 3, axis="x")
    axes.locator_params(nbins=6 if plane[1] == 1 else 3, axis="y")
    axes.tick_params(labelbottom=plane != (0, 1), labelleft=plane[0] == 0)
    if plane != (0, 1):
        axes.set_xlabel(names[0], fontsize=9, labelpad=2)
    if plane[0] == 0:
        axes.set_ylabel(names[1], fontsize=9, labelpad=2)
    title = "ZY" if plane == (2, 1) else "".join(AXES[i] for i in plane).upper()
    box = {"color": "white", "alpha": 0.8, "pad": 1.5, "linewidth": 0}
    style = {"fontsize": 8, "weight": "bold", "color": GREY, "bbox": box, "zorder": 4}
    at = {"xy": (0, 1), "xycoords": "axes fraction", "textcoords": "offset points"}
    axes.annotate(title, xytext=(4, -4), va="top", **at, **style)


def _write_texts(figure: Any, cloud: Cloud, box: Box, corner: tuple[float, float]) -> None:
    """The title, and in the corner what is shown and what not."""
    width, height = figure.get_size_inches()
    left, top = LEFT / width, 1 - 0.1 / height
    figure.text(left, top, shorten(cloud.name, 60) or cloud.name[:60], fontsize=11, va="top")
    counted = cloud.period >= 0
    with np.errstate(invalid="ignore"):
        inside = ((cloud.xyz >= box.low) & (cloud.xyz <= box.high)).all(axis=1)
    outside = int((counted & ~inside).sum())
    lines = [f"{int(counted.sum()):,} points", f"{len(cloud.centres):,} cameras"]
    if outside:
        lines.insert(1, f"{outside:,} outside")
    at = corner[0], corner[1] - 0.42 / height
    figure.text(*at, "\n".join(lines), fontsize=8, va="top", color=GREY, linespacing=1.4)


def _draw_legend(
    figure: Any, names: Sequence[str], colors: Sequence[str], columns: int, top: float
) -> None:
    from matplotlib.patches import Patch

    figure.legend(
        [Patch(color=color) for color in colors],
        names,
        loc="upper left",
        bbox_to_anchor=(LEFT / figure.get_size_inches()[0], top),
        borderaxespad=0,
        borderpad=0,
        ncol=min(columns, len(names)),
        frameon=False,
        fontsize=9,
        handlelength=1.0,
        handleheight=1.0,
        columnspacing=1.4,
    )
