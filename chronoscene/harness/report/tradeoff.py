"""Quality against cost over many runs: Pareto fronts, and the configuration for given limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.errors import ConfigError
from chronoscene.harness.files.command_line import command_line
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.comparable import several_scenes
from chronoscene.harness.report.summary import (
    PAPER_METRICS,
    SIZE,
    TIMES,
    metric_names,
    over_scenes,
    summarise,
    with_spread,
)
from chronoscene.harness.report.tables import ALL_SCENES, COST_TITLES
from chronoscene.images.store import MAX_WIDTH
from chronoscene.io.tables import Table
from chronoscene.io.wording import in_words
from chronoscene.metrics.registry import metric_info

if TYPE_CHECKING:
    from pandas import DataFrame

DRAWN_COSTS = (*TIMES, SIZE, "peak_memory_bytes", "peak_device_memory_bytes")
BUDGET_TOLERANCE = 0.05
"""Share by which a training, without its last step, may exceed a time and still count as one that
took it: a budget ends it after the step in which it runs out."""
SAME_TIME = 0.01
"""Share by which two times may differ and still be the same on a front: trainings of one budget end
a step after it at the latest."""
ANY_DEVICE = ""
FRONT_COLUMNS = (
    *("scene", "device", "metric", "cost", "label", "method", "strategy", "preset", "variant"),
    *("quality", "quality_sd", "value", "value_sd", "n", "on_front"),
)
"""Columns of `front_points`, one row per configuration and panel.

``scene`` may be `ALL_SCENES`; ``device`` is empty for costs other than `TIMES`, to which runs of
all devices belong; ``quality`` is the mean of the metric and ``value`` that of the cost over ``n``
seeds, in the unit of `RunRecord`, each with its sample standard deviation, None for one seed;
``on_front`` is True if no other configuration of the panel is as good for less, or better for as
much, where times are as much as others within `SAME_TIME`.
"""


def as_configurations(records: Sequence[RunRecord]) -> list[RunRecord]:
    """Add the width of the images to the variants of runs, where it is not the usual one.

    They have no rows: intervals over views are not asked for.
    """
    named = []
    for run in records:
        width = "" if run.max_width == MAX_WIDTH else f"max_width={run.max_width}"
        variant = ",".join(filter(None, (run.variant, width)))
        named.append(run.model_copy(update={"variant": variant, "rows": ()}))
    return named


def entries_by_device(records: Sequence[RunRecord]) -> dict[str, DataFrame]:
    """Summarise the runs of each device, and under `ANY_DEVICE` all runs.

    Where there are several scenes, their mean is one more, `ALL_SCENES`.
    """
    import pandas as pd

    found = {}
    for device in (*dict.fromkeys(run.device for run in records), ANY_DEVICE):
        entries = summarise([run for run in records if device in (ANY_DEVICE, run.device)])
        if several_scenes(entries.scene):
            entries = pd.concat([entries, over_scenes(entries, ALL_SCENES)], ignore_index=True)
        found[device] = entries
    return found


def front_points(records: Sequence[RunRecord]) -> DataFrame:
    """Tabulate all panels by scene, metric, cost and device, with the cheapest first in each.

    Returns:
        `FRONT_COLUMNS`.
    """
    import pandas as pd

    metrics = [name for name in metric_names(records) if name in PAPER_METRICS]
    panels = [
        _panel(part, device, metric, cost)
        for device, entries in entries_by_device(records).items()
        for _, part in entries.groupby("scene", sort=False)
        for metric in metrics
        for cost in DRAWN_COSTS
        if (device != ANY_DEVICE) == (cost in TIMES)
    ]
    panels = [panel for panel in panels if len(panel)]
    points = pd.concat(panels) if panels else pd.DataFrame(columns=FRONT_COLUMNS)
    orders = {"scene": points.scene.unique().tolist(), "metric": metrics, "cost": DRAWN_COSTS}
    return points.sort_values(
        list(orders), key=lambda names: names.map(orders[names.name].index), ignore_index=True
    )


def _panel(entries: DataFrame, device: str, metric: str, cost: str) -> DataFrame:
    """Compare the configurations on one scene and device."""
    quality = entries[(entries.quantity == metric) & (entries.column == "macro")]
    costs = entries[(entries.quantity == cost) & (entries.column == "")][["label", "mean", "sd"]]
    both = quality.merge(costs, on="label", suffixes=("", "_of_cost")).sort_values("mean_of_cost")
    sign = 1.0 if metric_info(metric).higher_is_better else -1.0
    both = both.assign(
        device=device,
        metric=metric,
        cost=cost,
        quality=both["mean"],
        quality_sd=both.sd.astype(object).where(both.n > 1, None),
        value=both.mean_of_cost,
        value_sd=both.sd_of_cost.astype(object).where(both.n > 1, None),
        on_front=on_front(
            both.mean_of_cost.to_numpy(),
            sign * both["mean"].to_numpy(),
            SAME_TIME if cost in TIMES else 0.0,
        ),
    )
    return both[[*FRONT_COLUMNS]]


def on_front(costs: Array, quality: Array, tolerance: float = 0.0) -> Mask:
    """Find the points to which no other one is as good for less, or better for as much. [N]

    Args:
        costs: Less is better. [N]
        quality: More is better. [N]
        tolerance: Share by which costs may differ that are the same.
    """
    more = costs * (1 + tolerance)
    no_worse = (costs[:, None] <= more) & (quality[:, None] >= quality)
    better = (more[:, None] < costs) | (quality[:, None] > quality)
    return np.logical_not((no_worse & better).any(axis=0))


def front_tables(points: DataFrame) -> list[Table]:
    """Make a table of the fronts for each scene and metric."""
    made = []
    fronts = points[points.on_front.astype(bool)]
    for (scene, metric), of_metric in fronts.groupby(["scene", "metric"], sort=False):
        rows, breaks = [], []
        for (cost, device), front in of_metric.groupby(["cost", "device"], sort=False):
            what = " on ".join(filter(None, (COST_TITLES[cost], device)))
            for number, point in enumerate(front.itertuples()):
                value = with_spread(cost, point.value, point.value_sd)
                quality = with_spread(metric, point.quality, point.quality_sd)
                rows.append(["" if number else what, point.label, value, quality])
            breaks.append(len(rows) - 1)
        name = metric_info(metric).title
        heads = ["against", "method", "cost", name]
        title = f"{scene}: Pareto fronts of {name} ({metric})"
        made.append(Table(heads, rows, labels=2, title=title, breaks=breaks[:-1]))
    return made


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of a configuration; None for no limit."""

    seconds: float | None = None
    """On the training clock."""
    size: float | None = None
    """Bytes of the stored model."""
    psnr: float | None = None
    """To be reached, in dB."""

    def excess(self, found: dict[str, Any]) -> float:
        """Return the largest ratio to a limit (of mean squared errors for PSNR), at most 1 if kept.

        Args:
            found: Mean ``seconds``, `SIZE`, ``psnr`` and ``iterations`` of a configuration.
        """
        ratios = [0.0]
        if self.seconds is not None:
            before = found["seconds"] * (1 - 1 / found["iterations"])
            ratios.append(before / (self.seconds * (1 + BUDGET_TOLERANCE)))
        if self.size is not None:
            ratios.append(found[SIZE] / self.size)
        if self.psnr is not None:
            ratios.append(10 ** ((self.psnr - found["psnr"]) / 10))
        return max(ratios)


def choose(records: Sequence[RunRecord], limits: Limits, wanted: str) -> list[str]:
    """Name the configuration to use within limits, in a sentence for each scene and device.

    It is the one with the best PSNR; where a PSNR is to be reached, the one with the shortest
    training. Where the printed values are equal, the other of these two decides, then the size of
    the model, and then the digits of PSNR that are not printed. Trainings that used up the budget
    count as equally long.

    Args:
        records: Runs of any scenes.
        limits: At least one.
        wanted: The options that gave them, as typed.

    Raises:
        ConfigError: If no configuration keeps to the limits on any scene.
    """
    sentences, fits_somewhere = [], False
    nearest: list[tuple[float, str]] = []
    for device, entries in entries_by_device(records).items():
        for scene, part in entries.groupby("scene", sort=False) if device else ():
            place = f"{scene}, {device}"
            found = sorted(_configurations(part), key=partial(_rank, budget=limits.seconds))
            if fitting := [config for config in found if limits.excess(config) <= 1]:
                best = fitting[0]
                if limits.psnr is not None:
                    best = min(fitting, key=lambda config: round(config["seconds"], 1))
                fits_somewhere = True
                sentences.append(f"{place}: {_sentence(best)}: {command_line('DIR', best)}")
            elif found:
                closest = min(found, key=lambda config: round(limits.excess(config), 2))
                near = _sentence(closest)
                nearest.append((limits.excess(closest), f"{near} on {place}"))
                sentences.append(f"{place}: nothing fits {wanted}; nearest: {near}")
    if not fits_somewhere:
        raise ConfigError(
            wanted,
            expected="limits that a trained run meets",
            found=f"none; nearest: {min(nearest)[1]}" if nearest else "no run that was trained",
            todo="allow more, or add runs of other presets and methods",
        )
    return sentences


def _configurations(entries: DataFrame) -> list[dict[str, Any]]:
    """List names and means of each configuration on a scene that has all limited quantities."""
    quantities = ("psnr", "seconds", SIZE)
    found = []
    for _, part in entries.groupby("label", sort=False):
        known = part[part.column.isin(("macro", ""))].set_index("quantity")
        if all(name in known.index for name in quantities):
            means = {name: float(known["mean"][name]) for name in quantities}
            texts = {f"{name}_text": known.text[name] for name in quantities}
            means["iterations"] = known["mean"].get("iterations", math.inf)
            found.append({**part.iloc[0], **means, **texts})
    return found


def _rank(config: dict[str, Any], budget: float | None) -> tuple[float, float, float, float]:
    """Return what is the least for the best; what a training took beyond the budget is no cost."""
    seconds = round(min(config["seconds"], budget or math.inf), 1)
    return -round(config["psnr"], 2), seconds, config[SIZE], -config["psnr"]


def _sentence(config: dict[str, Any]) -> str:
    return (
        f"{config['label']} reaches {config['psnr_text']} dB after {config['seconds_text']} s of "
        f"training with a model of {in_words(config[SIZE])}"
    )
