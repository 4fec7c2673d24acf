"""Quality against training time, as a plot for pages."""

from __future__ import annotations

import math
from collections.abc import Sequence
from textwrap import fill
from typing import NamedTuple

from markupsafe import Markup

from chronoscene.figures import canvas
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.summary import name_of
from chronoscene.harness.report.time_to_quality import read_curve

SIZE = (4.6, 2.6)  # Width and height in inches
STYLES = ("solid", "dashed", "dotted")
"""Line styles of matplotlib and of CSS, for the configurations of a method."""


class Curves(NamedTuple):
    """A plot and its legend."""

    svg: Markup
    legend: dict[str, tuple[str, str]]
    """Colour and line style of each method."""


def draw_curves(records: Sequence[RunRecord]) -> list[Curves]:
    """Draw PSNR of the probe views against seconds of training, from ``curve.csv`` of some runs.

    A run has a line for each of its models, whose seconds are its own.

    Args:
        records: Runs on one scene, as from `chronoscene.harness.report.summary.read_runs`.

    Returns:
        A plot for each device on which something was probed.
    """
    devices = dict.fromkeys(run.device for run in records)
    plots = [_draw([run for run in records if run.device == d], d) for d in devices]
    return [plot for plot in plots if plot is not None]


def _draw(records: Sequence[RunRecord], device: str) -> Curves | None:
    figure = canvas.new_figure(*SIZE, layout="constrained")
    time = fill(f"training [s] on {canvas.plain(device)}", 48)
    axes = figure.add_subplot(xlabel=time, ylabel="PSNR [dB]")
    canvas.quiet_axes(axes)
    axes.grid(axis="y", color=canvas.GRID, linewidth=0.6)
    methods = list(dict.fromkeys(record.method for record in records))
    colors = dict(zip(methods, canvas.period_colors(len(methods)), strict=True))
    legend: dict[str, tuple[str, str]] = {}
    titles: dict[str, str] = {}
    for record in records:
        color, name = colors[record.method], name_of(record)
        style = STYLES[sum(known == color for known, _ in legend.values()) % len(STYLES)]
        # None where another program made the images.
        found = [point for point in read_curve(record.folder) if math.isfinite(point.psnr)]
        for model in dict.fromkeys(point.model for point in found):
            legend[name] = color, style
            points = [(point.seconds, point.psnr) for point in found if point.model == model]
            axes.plot(*zip(*points, strict=True), color=color, linestyle=style)
            for x, y in points:
                gid, label = f"probe-{len(titles)}", name if model == "all" else f"{name}, {model}"
                titles[gid] = f"{label}: {y:.2f} dB at {x:.1f} s"
                axes.plot(x, y, "o", color=color, markersize=4, gid=gid)
    if not legend:
        return None
    axes.set_xlim(left=0)
    return Curves(
        canvas.inline_svg(figure, "PSNR of the probe views by training time", titles), legend
    )
