"""Scores of single test views, methods side by side, the worst views first."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.summary import in_unit, labelled
from chronoscene.harness.report.tables import period_name
from chronoscene.harness.score.regions import ALL
from chronoscene.io.tables import Head, Table
from chronoscene.metrics.registry import metric_info

if TYPE_CHECKING:
    from pandas import DataFrame

WORST = 10
"""Views in a table for a person."""


def view_scores(records: Sequence[RunRecord], metric: str) -> DataFrame:
    """Tabulate a metric of each test view, averaged over seeds: views in rows, methods in columns.

    Args:
        records: Runs with their rows, as from `chronoscene.harness.report.summary.read_runs`.
        metric: Its name.

    Returns:
        Indexed by scene, period and view: those of a scene stand together, the worst mean over
        methods first. NaN where a method has no value.

    Raises:
        ConfigError: If no run has the metric.
    """
    import pandas as pd

    rows = [
        (run.scene, row.camera_period, row.view, label, row.value)
        for run, label in zip(records, labelled(records).label, strict=True)
        for row in run.rows
        if row.metric == metric and row.region == ALL and row.rendered_period == row.camera_period
    ]
    if not rows:
        raise ConfigError(
            f"--metric {metric}",
            expected="a metric that the runs were scored by",
            found="no value of a test view",
            todo=f"run chronoscene score RUNS --metric {metric}, or name another one",
        )
    names = ["scene", "period", "view"]
    values = pd.DataFrame(rows, columns=[*names, "label", "value"])
    table = values.pivot_table("value", names, "label", "mean", sort=False)
    ascending = metric_info(metric).higher_is_better
    worst_first = table.mean(axis=1).sort_values(ascending=ascending, kind="stable").index
    return table.loc[worst_first].sort_index(level="scene", sort_remaining=False, kind="stable")


def worst_views(scores: DataFrame, records: Sequence[RunRecord], metric: str) -> Iterator[Table]:
    """Make a table of the `WORST` views of each scene, from `view_scores`."""
    info = metric_info(metric)
    for scene, part in scores.groupby(level="scene"):
        labels = next(run.period_labels for run in records if run.scene == scene)
        there = part.dropna(axis="columns", how="all")
        rows = [
            [view, period_name(period, labels)]
            + ["-" if value != value else in_unit(metric, value) for value in values]
            for (_, period, view), values in zip(there.index, there.to_numpy(), strict=True)
        ]
        names = [label.partition(" (") for label in there.columns]
        heads: list[Head] = ["view", "period"]
        heads += [(name, (bracket + kind).strip()) for name, bracket, kind in names]
        title = f"{scene}: {info.title} ({metric}) of single views, worst mean over methods first"
        if len(rows) > WORST:
            title += f"; {WORST} of {len(rows)}"
        yield Table(heads, rows[:WORST], labels=2, title=title)
