"""Figure of what scenes need: blocks of features per anchor, or whatever the primitives are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from textwrap import fill
from typing import Any

import numpy as np

from chronoscene.figures import canvas
from chronoscene.harness.files.records import FIGURES, RunRecord
from chronoscene.harness.report.summary import name_of

COLUMNS = 2
PANEL = (4.2, 2.3)  # Inches
NUMBERED = 24  # Bars of a panel up to which they have numbers


def draw_sharing(runs: Path, records: Sequence[RunRecord]) -> list[Path]:
    """Draw a bar chart for each scene, means over seeds; returns the file, if there is one."""
    scenes: dict[str, dict[str, list[RunRecord]]] = {}
    for record in records:
        if record.sharing is not None:
            of_scene = scenes.setdefault(record.scene, {})
            of_scene.setdefault(name_of(record), []).append(record)
    if not scenes:
        return []
    labels = list(dict.fromkeys(label for of_scene in scenes.values() for label in of_scene))
    colors = dict(zip(labels, canvas.period_colors(len(labels)), strict=True))
    columns, rows = min(COLUMNS, len(scenes)), -(-len(scenes) // COLUMNS)
    size = (PANEL[0] * columns, PANEL[1] * rows)
    figure = canvas.new_figure(size[0], size[1] + 0.4, layout="constrained", dpi=150)
    panels: Any = figure.subplots(rows, columns, squeeze=False)
    for axes in panels.flat[len(scenes) :]:
        axes.set_axis_off()
    for axes, (scene, of_scene) in zip(panels.flat, scenes.items(), strict=False):
        _draw_panel(axes, of_scene, colors)
        axes.set_title(canvas.plain(scene), fontsize=9)
    entries = [(fill(label, 60), color) for label, color in colors.items()]
    canvas.add_legend(figure, entries, columns, loc="outside upper center")
    path = runs / FIGURES / "blocks.png"
    canvas.save(figure, path)
    return [path]


def _draw_panel(
    axes: Any, of_scene: Mapping[str, Sequence[RunRecord]], colors: Mapping[str, str]
) -> None:
    """Draw the shares of primitives with 1, 2, ... blocks side by side for all methods."""
    shares = {}
    for label, records in of_scene.items():
        found = [run.sharing.blocks for run in records if run.sharing is not None]
        shares[label] = np.mean([100 * np.array(blocks) / sum(blocks) for blocks in found], axis=0)
    periods = max(map(len, shares.values()))
    width = 0.8 / len(shares)
    for i, (label, values) in enumerate(shares.items()):
        at = np.arange(1, len(values) + 1) + (i - (len(shares) - 1) / 2) * width
        bars = axes.bar(at, values, width, color=colors[label])
        if periods * len(shares) <= NUMBERED:
            axes.bar_label(bars, fmt="%.0f", fontsize=7, color=canvas.GREY, padding=1)
    first = next(iter(of_scene.values()))[0]
    canvas.quiet_axes(axes)
    axes.margins(y=0.12)
    axes.locator_params(axis="x", integer=True)
    axes.set_xlabel(f"blocks of features, for {periods} periods", fontsize=8)
    axes.set_ylabel(f"share of {first.primitive} [%]", fontsize=8)
