"""Tables of runs: mean and spread over seeds, per method, period and aggregate."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev
from typing import TYPE_CHECKING, Any

from chronoscene.bench.results import Failure, RunRecord, read_failures, read_run, run_folders
from chronoscene.errors import CheckpointError
from chronoscene.io import tables
from chronoscene.io.tables import Table
from chronoscene.metrics.registry import MetricInfo, all_metrics, metric_info

if TYPE_CHECKING:
    from pandas import DataFrame, Series

AGGREGATES = ("macro", "micro", "worst")


@dataclass(frozen=True, slots=True)
class Cost:
    """A column of the cost table."""

    name: str
    """Field of `RunRecord`."""
    title: str
    factor: float
    decimals: int


COSTS = (
    Cost("seconds", "training [s]", 1.0, 1),
    Cost("iterations", "iterations", 1.0, 0),
    Cost("primitives", "primitives", 1.0, 0),
    Cost("drawn", "drawn per view", 1.0, 0),
    Cost("render_seconds", "rendering [ms]", 1e3, 1),
    Cost("checkpoint_bytes", "checkpoint [MB]", 1e-6, 3),
    Cost("peak_memory_bytes", "peak memory [MB]", 1e-6, 0),
    Cost("peak_device_memory_bytes", "peak GPU memory [MB]", 1e-6, 0),
)

ENTRY_COLUMNS = (
    *("scene", "method", "strategy", "preset", "variant", "config_hash"),
    *("quantity", "column", "mean", "sd", "n", "seeds", "device", "commit"),
)
"""Columns of CSV and JSON. ``quantity`` is a metric, or a cost in the unit of `RunRecord`;
``column`` is ``macro``, ``micro``, ``worst``, ``period <id>``, or empty for costs; ``sd`` is the
sample standard deviation over ``n`` seeds, empty for one seed."""


def read_runs(folders: Iterable[Path]) -> tuple[list[RunRecord], list[Failure]]:
    """All finished and failed runs below some folders.

    Raises:
        CheckpointError: If a folder holds neither.
    """
    records: list[RunRecord] = []
    failures: list[Failure] = []
    for folder in folders:
        found = [read_run(path) for path in run_folders(folder)]
        failed = read_failures(folder)
        if not found and not failed:
            raise CheckpointError(
                folder, expected="a folder of runs", found="no run in it", todo="run bench first"
            )
        records += found
        failures += failed
    return records, failures


def format_runs(
    records: Sequence[RunRecord],
    failures: Sequence[Failure],
    style: str,
    metrics: Sequence[str] = (),
) -> str:
    """All tables of some runs in one of `chronoscene.io.tables.FORMATS`."""
    entries = summarise(records, metrics)
    if style == "csv":
        # NaN is a spread that is not defined, an empty cell that there is none.
        entries["sd"] = [
            "" if n == 1 else repr(sd) for n, sd in zip(entries.n, entries.sd, strict=True)
        ]
        return str(entries.to_csv(columns=ENTRY_COLUMNS, index=False, lineterminator="\n"))
    notes = footnotes(entries, records, failures, metrics)
    if style == "json":
        found = [_json_entry(entry) for entry in entries[[*ENTRY_COLUMNS]].to_dict("records")]
        return json.dumps({"entries": found, "notes": notes}, indent=1, allow_nan=False) + "\n"
    made = readable_tables(entries, records, metrics)
    if style == "markdown":
        texts, bullet = [tables.markdown(t, special=r"\`*<>|_") for t in made], "- "
    elif style == "latex":
        texts, bullet = [tables.latex(table) for table in made], "% "
    else:
        texts, bullet = [tables.plain_text(table) for table in made], ""
    return "\n".join([*texts, "".join(f"{bullet}{note}\n" for note in notes)])


def _json_entry(entry: dict[str, Any]) -> dict[str, Any]:
    """Numbers that JSON lacks become the strings ``Infinity`` and ``NaN``."""
    entry["sd"] = None if entry["n"] == 1 else entry["sd"]
    for key in ("mean", "sd"):
        if entry[key] is not None and not math.isfinite(entry[key]):
            names = {math.inf: "Infinity", -math.inf: "-Infinity"}
            entry[key] = names.get(entry[key], "NaN")
    return entry


def summarise(records: Sequence[RunRecord], metrics: Sequence[str] = ()) -> DataFrame:
    """Mean and spread over seeds of everything that was measured.

    Runs that differ in the seed only are a group. Equal names with other scenes, configs or devices
    stay apart: their ``label`` says in what they differ.

    Args:
        records: Runs of any scenes.
        metrics: Names of those wanted; none for all.

    Returns:
        `ENTRY_COLUMNS` and ``label``, one row per group, quantity and column. What a run of a group
        lacks is left out.
    """
    import pandas as pd

    if not records:
        return pd.DataFrame(columns=[*ENTRY_COLUMNS, "label"])
    runs = _labelled(records).sort_values("seed", kind="stable")
    in_group = runs.groupby(["scene", "label"], sort=False)
    groups = in_group[["method", "strategy", "preset", "variant", "config_hash", "device"]].first()
    groups["runs"] = in_group.size()
    groups["seeds"] = in_group.seed.agg(lambda seeds: " ".join(map(str, seeds)))
    groups["commit"] = in_group.commit.agg(lambda commits: " ".join(commits.unique()))

    numbers = [
        (run.scene, label, *number)
        for run, label in zip(records, runs.label.sort_index(), strict=True)
        for number in _numbers(run, metric_names([run], metrics))
    ]
    columns = ["scene", "label", "quantity", "column", "value"]
    values = pd.DataFrame(numbers, columns=columns).groupby(columns[:-1], sort=False).value
    entries = values.agg(mean=mean, sd=_spread, n="size").reset_index()
    entries = entries.join(groups, on=["scene", "label"])
    order = {scene: i for i, scene in enumerate(dict.fromkeys(run.scene for run in records))}
    entries = entries[entries.n == entries.runs]
    return _with_text(entries).sort_values(
        "scene", key=lambda scenes: scenes.map(order), kind="stable", ignore_index=True
    )


def _with_text(entries: DataFrame) -> DataFrame:
    """Entries with ``text``, ``mean`` or ``mean ± sd``, and ``shown``, the mean as it reads."""
    # Quantity to its factor from the stored to the shown unit, and to its decimals
    display = {name: (1.0, info.decimals) for name, info in all_metrics().items()}
    display |= {cost.name: (cost.factor, cost.decimals) for cost in COSTS}
    texts, shown = [], []
    for quantity, value, sd, n in entries[["quantity", "mean", "sd", "n"]].itertuples(index=False):
        factor, decimals = display[quantity]
        spread = "" if n == 1 else f" ± {sd * factor:.{decimals}f}"
        texts.append(f"{value * factor:.{decimals}f}{spread}")
        shown.append(round(value * factor, decimals))
    return entries.assign(text=texts, shown=shown)


def _labelled(records: Sequence[RunRecord]) -> DataFrame:
    """What tells runs apart, one row per record."""
    import pandas as pd

    fields = ("scene", "method", "strategy", "preset", "variant", "config_hash", "seed", "device")
    runs = pd.DataFrame(
        [{name: getattr(run, name) for name in (*fields, "commit")} for run in records]
    )
    runs["label"] = [f"{run.title} ({kind_of(run)})" for run in records]
    differences = pd.DataFrame(
        {
            "method": runs.method,
            "scene": [f"scene {run.scene_hash[:6]}" for run in records],
            "config": [f"config {run.config_hash[:6]}" for run in records],
            "device": runs.device,
        }
    )
    differ = differences.groupby([runs.scene, runs.label]).transform("nunique") > 1
    for i, columns in enumerate(differ.to_numpy()):
        if columns.any():
            told = ", ".join(differences.loc[i, columns])
            runs.loc[i, "label"] += f" [{told}]"
    return runs


def kind_of(run: RunRecord | Failure) -> str:
    """Strategy and preset, and what differs from it."""
    return ", ".join(filter(None, (run.strategy, run.preset, run.variant.replace(",", ", "))))


def _numbers(run: RunRecord, metrics: Sequence[str]) -> Iterable[tuple[str, str, float]]:
    """Quantity, column and value of everything that a run gave, in the order of the tables."""
    sources = {f"period {i}": run.periods[i] for i in sorted(run.periods, key=int)}
    sources |= {name: run.aggregates[name] for name in AGGREGATES}
    for metric in metrics:
        for column, values in sources.items():
            if metric in values:
                yield metric, column, values[metric]
    for cost in COSTS:
        if (value := getattr(run, cost.name)) is not None:
            yield cost.name, "", float(value)


def _spread(values: Series) -> float:
    """Sample standard deviation (n - 1); NaN for one value, or where one is infinite."""
    return stdev(values) if len(values) > 1 and all(map(math.isfinite, values)) else math.nan


def metric_names(records: Iterable[RunRecord], wanted: Sequence[str] = ()) -> list[str]:
    """The metrics to show, in the order of the table of names: those wanted, or all there are."""
    known = [metric_info(name).name for name in wanted]
    there = {name for run in records for name in run.aggregates.get("macro", {})}
    return [name for name in all_metrics() if name in there and (not known or name in known)]


def readable_tables(
    entries: DataFrame, records: Sequence[RunRecord], metrics: Sequence[str] = ()
) -> list[Table]:
    """Per scene a table of each metric and one of costs; a summary if there are several scenes.

    Args:
        entries: What `summarise` returns for the records.
        records: The runs.
        metrics: Names of those wanted; none for all.
    """
    names = metric_names(records, metrics)
    made = []
    for scene, part in entries.groupby("scene", sort=False):
        runs = [run for run in records if run.scene == scene]
        made += [_quality_table(part, name, runs) for name in names]
        if (part.column == "").any():  # nobody knows what images of other programs cost
            made.append(_cost_table(part, str(scene)))
    if entries.scene.nunique() > 1:
        made += [_summary_table(entries, name) for name in names]
    return made


def cost_tables(records: Sequence[RunRecord]) -> list[Table]:
    """What runs cost, a table per scene."""
    return [
        _cost_table(part, str(scene))
        for scene, part in summarise(records).groupby("scene", sort=False)
    ]


def _quality_table(part: DataFrame, metric: str, runs: Sequence[RunRecord]) -> Table:
    """One metric on one scene: methods by periods and aggregates."""
    info = metric_info(metric)
    ids = sorted({i for run in runs for i in run.periods}, key=int)
    columns = [*(f"period {i}" for i in ids), *AGGREGATES]
    rows, best = _cells(part[part.quantity == metric], "column", columns, part, info)
    rows = [[*row, str(n)] for row, n in zip(rows, _of_groups(part, "runs"), strict=True)]
    titles = [_period_title(i, runs[0].period_labels) for i in ids]
    arrow = "higher" if info.higher_is_better else "lower"
    title = f"{runs[0].scene}: {info.title} ({metric}), {arrow} is better"
    return Table(_heads("method", *titles, *AGGREGATES, "n"), rows, title=title, best=best)


def _period_title(period: str, labels: dict[str, str]) -> str:
    label = labels.get(period, period)
    return f"period {period}" if label == period else f"{period}: {label}"


def _cost_table(part: DataFrame, scene: str) -> Table:
    """What the runs on one scene cost."""
    shown = [cost for cost in COSTS if (part.quantity == cost.name).any()]
    rows, _ = _cells(part[part.column == ""], "quantity", [cost.name for cost in shown], part)
    rows = [[*row, seeds] for row, seeds in zip(rows, _of_groups(part, "seeds"), strict=True)]
    heads = _heads("method", *(cost.title for cost in shown), "seeds")
    return Table(heads, rows, title=f"{scene}: cost")


def _summary_table(entries: DataFrame, metric: str) -> Table:
    """Macro means of one metric: methods by scenes, and their mean where no scene is missing."""
    import pandas as pd

    info = metric_info(metric)
    macro = entries[(entries.quantity == metric) & (entries.column == "macro")]
    scenes = list(entries.scene.unique())
    whole = macro.groupby("label").filter(lambda group: len(group) == len(scenes))
    overall = whole.groupby("label", sort=False)["mean"].agg(mean).reset_index()
    overall = overall.assign(scene="mean of scenes", quantity=metric, sd=math.nan, n=1)
    columns = [*scenes, "mean of scenes"]
    both = pd.concat([macro, _with_text(overall)])
    rows, best = _cells(both, "scene", columns, entries, info)
    title = f"all scenes: {info.title} ({metric}), macro"
    return Table(_heads("method", *columns), rows, title=title, best=best)


def _heads(*names: str) -> list[tables.Head]:
    return [(name, "") for name in names]


def _of_groups(part: DataFrame, column: str) -> Series:
    """What all entries of a group have in common, one value per label."""
    return part.groupby("label", sort=False)[column].first()


def _cells(
    entries: DataFrame,
    by: str,
    columns: Sequence[str],
    whole: DataFrame,
    metric: MetricInfo | None = None,
) -> tuple[list[list[str]], set[tuple[int, int]]]:
    """Label and texts of each row, and the places of the best of each column.

    Args:
        entries: At most one for each label and column.
        by: Column of ``entries`` that says where in a row it belongs.
        columns: Values of ``by`` in the order of the table.
        whole: Entries with all labels, in the order of the table.
        metric: Says what is better; None if nothing is.
    """
    labels = whole.label.unique()
    texts = entries.pivot(index="label", columns=by, values="text")
    texts = texts.reindex(index=labels, columns=columns).astype(object).fillna("-")
    rows = [[label, *row] for label, row in zip(labels, texts.to_numpy(), strict=True)]
    if metric is None or len(labels) < 2:
        return rows, set()
    # What reads the same in the table is marked alike.
    shown = entries.pivot(index="label", columns=by, values="shown")
    shown = shown.reindex(index=labels, columns=columns)
    best = shown.max() if metric.higher_is_better else shown.min()
    return rows, {(i, 1 + j) for i, j in zip(*shown.eq(best).to_numpy().nonzero(), strict=True)}


def footnotes(
    entries: DataFrame,
    records: Sequence[RunRecord],
    failures: Sequence[Failure],
    wanted: Sequence[str] = (),
) -> list[str]:
    """What a reader must know: aggregates, spread, device, code, what is absent and why."""
    notes = ["macro: mean over periods; micro: mean over test views; worst: the worst period"]
    if (entries.n > 1).any():
        notes.append("±: sample standard deviation over n seeds")
    for name, title in (("device", "device"), ("commit", "code")):
        values = dict.fromkeys(str(getattr(run, name)) for run in records)
        if values:
            notes.append(f"{title}: {'; '.join(values)}")
    counted: dict[str, dict[str, None]] = {}
    for run in records:
        if run.primitives is not None:
            counted.setdefault(run.primitive, {})[run.title] = None
    if counted:
        units = "; ".join(f"{unit} of {', '.join(titles)}" for unit, titles in counted.items())
        notes.append(f"primitives: {units}")
    absent: dict[str, list[str]] = {}
    costs = {cost.name: cost.title for cost in COSTS}
    for run in records:
        skipped = {m: why for m, why in run.skipped.items() if not wanted or m in wanted}
        costly = {costs[c]: why for c, why in run.absent.items() if c in costs}
        for name, reason in {**skipped, **costly}.items():
            names = absent.setdefault(reason, [])
            if name not in names:
                names.append(name)
    notes += [f"absent: {', '.join(names)}: {reason}" for reason, names in absent.items()]
    notices = dict.fromkeys(notice for run in records for notice in run.notices)
    seeds: dict[tuple[str, str], list[str]] = {}
    for f in failures:
        name = f"{f.scene}, {f.method} ({kind_of(f)})"
        seeds.setdefault((name, f.reason), []).append(str(f.seed))
    failed = [f"failed: {n}, seed {', '.join(s)}: {reason}" for (n, reason), s in seeds.items()]
    return [*notes, *notices, *failed]
