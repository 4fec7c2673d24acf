"""Figure of runs in stages: scores of each period after each stage, as heat maps."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from textwrap import fill, shorten
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.figures import canvas
from chronoscene.harness.files.predictions import safe_part
from chronoscene.harness.files.records import FIGURES, RunRecord
from chronoscene.harness.report.summary import kind_of
from chronoscene.harness.report.tables import period_name
from chronoscene.harness.score.forgetting import stage_matrix
from chronoscene.metrics.registry import MetricInfo, metric_info

METRICS = ("psnr", "ssim", "lpips_vgg")
"""Metrics that are drawn, as far as there are values."""
WRITTEN = 10
"""Periods up to which cells have numbers."""
TITLE_WIDTH = 30  # Characters


def draw_stages(runs: Path, records: Sequence[RunRecord]) -> list[Path]:
    """Draw the runs in stages of every scene, means over their seeds; returns the files."""
    scenes: dict[str, dict[str, list[RunRecord]]] = {}
    for record in records:
        if record.stages:
            rows = scenes.setdefault(record.scene, {})
            title = f"{record.title}\n{fill(kind_of(record), TITLE_WIDTH, break_long_words=False)}"
            rows.setdefault(title, []).append(record)
    written = []
    for scene, rows in scenes.items():
        there = next(iter(rows.values()))[0].aggregates["macro"]
        metrics = [metric for metric in METRICS if metric in there]
        if not metrics:  # trained on all photos
            continue
        path = runs / FIGURES / f"{safe_part(scene)}_stages.png"
        _draw(path, scene, rows, metrics)
        written.append(path)
    return written


def _draw(path: Path, scene: str, rows: dict[str, list[RunRecord]], metrics: Sequence[str]) -> None:
    """Draw one row of heat maps for each metric, one column for each method."""
    first = next(iter(rows.values()))[0]
    names = [period_name(i, first.period_labels) for i in first.period_labels]
    names = [canvas.plain(shorten(name, 20)) for name in names]
    side = 1.2 + 0.45 * min(len(names), 2 * WRITTEN)
    size = ((0.6 + side) * len(rows) + 1.0, (0.8 + side) * len(metrics) + 0.6)
    figure = canvas.new_figure(*size, layout="constrained", dpi=150)
    axes: Any = figure.subplots(len(metrics), len(rows), squeeze=False)
    for row, metric in zip(axes, metrics, strict=True):
        info = metric_info(metric)
        found = [
            np.mean([stage_matrix(run.stages, metric) for run in records], axis=0)
            for records in rows.values()
        ]
        for axis, values, title in zip(row, found, rows, strict=True):
            image = _draw_matrix(axis, values, found, names, info)
            axis.set_title(canvas.plain_lines(f"{title}\n{info.title}"), fontsize=9)
        figure.colorbar(image, ax=list(row), shrink=0.8, aspect=20)
    title = f"{scene}: test views of each period; below the red line, those of periods seen so far"
    figure.suptitle(canvas.plain(title), fontsize=10)
    canvas.save(figure, path, bbox_inches="tight", pad_inches=0.1)


def _draw_matrix(
    axis: Any, values: Array, found: Sequence[Array], names: Sequence[str], metric: MetricInfo
) -> Any:
    """Draw one heat map, in colours for the trained models of all those ``found``."""
    known = np.concatenate([matrix[1:][np.isfinite(matrix[1:])] for matrix in found])
    low, high = (known.min(), known.max()) if len(known) else (0.0, 0.0)  # all are infinite
    colors = "viridis" if metric.higher_is_better else "viridis_r"
    image = axis.imshow(values, vmin=low, vmax=high, cmap=colors)
    axis.set_facecolor("0.9")
    periods = len(names)
    for (row, column), value in np.ndenumerate(values):
        if periods <= WRITTEN and not np.isnan(value):
            is_bright = (value - low > 0.6 * (high - low)) == metric.higher_is_better
            ink = "black" if is_bright else "white"
            text = f"{value:.{metric.decimals}f}"
            axis.text(column, row, text, ha="center", va="center", color=ink, fontsize=7)
    steps = np.arange(periods + 1)
    axis.step(steps - 0.5, np.minimum(steps + 0.5, periods + 0.5), where="post", color="red", lw=1)
    axis.set_xticks(range(periods), names, rotation=90, fontsize=7)
    axis.set_yticks(range(periods + 1), ["no training", *names], fontsize=7)
    axis.set_ylabel("trained up to", fontsize=8)
    return image
