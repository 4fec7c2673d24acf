"""Tables and plots of a scene: verified rows are ranked, those claimed and published are not."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from markupsafe import Markup

from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.comparable import Setting
from chronoscene.harness.report.summary import (
    PAPER_METRICS,
    SIZE,
    in_unit,
    metric_names,
    short_commits,
)
from chronoscene.harness.report.tables import period_title
from chronoscene.harness.report.tradeoff import SAME_TIME
from chronoscene.metrics.registry import metric_info
from leaderboard.pareto import Point, plot
from leaderboard.scenes import meaning_of, role_of

if TYPE_CHECKING:
    from pandas import DataFrame

VERIFIED = "Verified"
CLAIMED = "Claimed, not ranked"
"""Kinds of measured results: scored again from their images when the site was built, or not."""
COSTS = {
    "seconds": "training [s], reported",
    SIZE: "size [MB], reported",
    "peak_memory_bytes": "memory [MB], reported",
}
Column = tuple[str, str, str]
"""Quantity and column of `summarise`, and the title."""

PRINTED_COLUMNS = (
    *((name, "macro", metric_info(name).title) for name in PAPER_METRICS),
    (SIZE, "", "size [MB]"),
)
"""Quantity, column and title of the published numbers."""


class Part(NamedTuple):
    """Runs of one kind in one setting."""

    runs: list[RunRecord]
    values: DataFrame
    """By `summarise`."""


def make_group(
    setting: Setting, found: Mapping[str, Part], printed: DataFrame, colors: Mapping[str, str]
) -> dict[str, Any]:
    """Make the table and the plots of runs that may stand side by side.

    ``colors``: by the name of a method.
    """
    runs = [run for part in found.values() for run in part.runs]
    labels = {i: label for run in reversed(runs) for i, label in run.period_labels.items()}
    periods = sorted({i for run in runs for i in run.periods}, key=int)
    names = metric_names(runs)
    quality, *others = [name for name in PAPER_METRICS if name in names] or names
    parts: dict[str, DataFrame] = {}
    devices: dict[str, None] = {}
    for kind, (_, part) in found.items():
        timed = part.quantity == "seconds"
        parts[kind] = part.assign(column=part.column.mask(timed, part.device))
        devices |= dict.fromkeys(part.device[timed])
    times = [
        ("seconds", device, COSTS["seconds"] + (f", {device}" if len(devices) > 1 else ""))
        for device in devices
    ]
    columns = [
        (quality, "macro", metric_info(quality).title),
        *((quality, f"period {i}", period_title(i, labels)) for i in periods),
        *((name, "macro", metric_info(name).title) for name in others),
        *times,
        *((name, "", title) for name, title in COSTS.items() if name != "seconds"),
    ]
    table = make_table(columns, parts, printed)
    ranked = table["rows"].get(VERIFIED, [])
    legend = {i: (row["label"], colors[row["method"]]) for i, row in enumerate(ranked, 1)}
    return {
        **table,
        "setting": setting,
        "plots": _plots(parts[VERIFIED], legend, times, quality) if ranked else [],
        "legend": legend,
        "role": meaning_of(role_of(setting.scene_hash)),
        "devices": list(dict.fromkeys(run.device for run in runs)),
        "commits": list(dict.fromkeys(short_commits(run.commit) for run in runs)),
    }


def _plots(
    part: DataFrame, legend: Mapping[int, tuple[str, str]], times: Sequence[Column], quality: str
) -> list[Markup]:
    """Plot quality against costs, but for costs that are much the same."""
    values = part.set_index(["label", "quantity", "column"])["mean"]
    plots = []
    for name, column, cost in (*times, (SIZE, "", "size of the model [MB], reported")):
        points = []
        for i, (label, _) in legend.items():
            spent, gained = (label, name, column), (label, quality, "macro")
            if {spent, gained} <= {*values.index}:
                points.append(Point(i, float(in_unit(name, values[spent])), values[gained]))
        same = SAME_TIME if name == "seconds" else 0.0
        plots.append(plot(points, legend, cost=cost, metric=quality, tolerance=same))
    return [p for p in plots if p is not None]


def make_table(
    columns: Sequence[Column], measured: Mapping[str, DataFrame], printed: DataFrame
) -> dict[str, Any]:
    """Make a table for the page of a scene; ``rows`` has those verified before those claimed."""
    found = {
        kind: sorted(
            make_rows(part, columns, ranked=kind == VERIFIED),
            key=lambda row: row_order(kind, row["label"], row["cells"][0]),
        )
        for kind, part in measured.items()
        if len(part)
    }
    return {
        "columns": [title for _, _, title in columns],
        "lower": [q in COSTS or not metric_info(q).higher_is_better for q, _, _ in columns],
        "rows": found,
        "printed": make_rows(printed, columns),
        "tied": any(cell and cell["tied"] for r in found.get(VERIFIED, []) for cell in r["cells"]),
    }


def make_rows(
    part: DataFrame, columns: Sequence[Column], *, by: str = "label", ranked: bool = True
) -> list[dict[str, Any]]:
    """Make the rows of a table, one per label or per scene."""
    groups: dict[str, list[Any]] = {}
    for row in part.itertuples(index=False):
        groups.setdefault(getattr(row, by), []).append(row)
    rows = []
    for name, own in groups.items():
        found = {(row.quantity, row.column): row for row in own}
        cells = [
            make_cell(found[q, c], ranked=ranked) if (q, c) in found else None
            for q, c, _ in columns
        ]
        rows.append({by: name, "method": own[0].method, "seeds": own[0].seeds, "cells": cells})
    return rows


def make_cell(row: Any, *, ranked: bool = True) -> dict[str, Any]:
    """Make a cell of a table from a row of `summarise`; the best is marked where it is ranked."""
    interval = ""
    if math.isfinite(row.low) and row.column == "macro":
        interval = f"{in_unit(row.quantity, row.low)} to {in_unit(row.quantity, row.high)}"
    return {
        "text": row.text,
        "value": float(row.mean),
        "interval": interval,
        "tied": ranked and bool(row.tied),
        "best": ranked and row.rank == 1,
    }


def row_order(kind: str, label: str, cell: dict[str, Any] | None) -> tuple[float, str]:
    """Sort verified rows by their value, and the others by their name."""
    if kind == CLAIMED:
        return 0.0, label.casefold()
    return -cell["value"] if cell else math.inf, label
