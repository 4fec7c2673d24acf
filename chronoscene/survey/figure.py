"""Picture of two periods: map, surface model, difference of elevations, level of detection."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.figures import canvas
from chronoscene.survey.difference import Difference
from chronoscene.survey.grid import Grid
from chronoscene.survey.surface import Surface

MAX_SIDE = 1200  # Cells of a panel; of larger rasters, every n-th is shown
WIDTH = 3.6  # Of a panel, inches


def draw_difference(
    path: Path, grid: Grid, later: Surface, difference: Difference, labels: tuple[str, str]
) -> None:
    """Draw a later period and what changed since an earlier one.

    Args:
        path: File to write; the suffix says the format.
        grid: Cells.
        later: Surface of the later period.
        difference: Between the periods.
        labels: Of the earlier and the later period.
    """
    from matplotlib.ticker import MaxNLocator

    step = -(-max(grid.shape) // MAX_SIDE)
    edges = (
        grid.left, grid.left + grid.width * grid.resolution,
        grid.top - grid.height * grid.resolution, grid.top,
    )  # fmt: skip
    height = float(np.clip(WIDTH * grid.height / grid.width, 1.5, 7.0))
    figure = canvas.new_figure(2 * WIDTH + 2.0, 2 * height + 1.0, layout="constrained", dpi=150)
    axes = figure.subplots(2, 2, sharex=True, sharey=True)
    first, second = (canvas.plain(label) for label in labels)
    changed = np.where(difference.significant, difference.values, np.nan)
    limit = max(_range(np.abs(changed))[1], 1e-3)
    compared = np.where(np.isfinite(difference.values), 0.9, 1.0)[..., None].repeat(3, axis=2)
    photo = np.where(np.isfinite(later.heights)[..., None], later.colors, 255)

    def show(
        panel: Any, values: Any, title: str, colors: str | None = None, limits: Any = (None, None)
    ) -> None:
        drawn = panel.imshow(
            values[::step, ::step], extent=edges, interpolation="nearest",
            cmap=colors, vmin=limits[0], vmax=limits[1],
        )  # fmt: skip
        panel.set_title(title, fontsize=9)
        canvas.quiet_axes(panel)
        panel.xaxis.set_major_locator(MaxNLocator(4))
        if colors:
            bar = figure.colorbar(drawn, ax=panel, fraction=0.04, pad=0.02)
            bar.set_label("m", fontsize=8)
            bar.ax.tick_params(labelsize=8)

    (top_left, top_right), (left, right) = axes
    show(top_left, photo, f"Orthophoto, {second}")
    show(top_right, later.heights, f"Height, {second}", "viridis", _range(later.heights))
    show(left, compared, "")
    show(left, changed, f"Difference to {first}, where significant", "RdBu", (-limit, limit))
    level = (0.0, _range(difference.level)[1])
    show(right, difference.level, "Level of detection, 95 %", "magma", level)
    left.ticklabel_format(style="plain", useOffset=False)
    figure.supxlabel("east (m)", fontsize=9)
    figure.supylabel("north (m)", fontsize=9)
    canvas.save(figure, path)


def _range(values: Array) -> tuple[float, float]:
    """Percentiles 1 and 99 of the known values; 0 and 1 without any."""
    known = values[np.isfinite(values)]
    low, high = np.percentile(known, [1, 99]) if len(known) else (0.0, 1.0)
    return float(low), float(high)
