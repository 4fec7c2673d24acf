"""Tables of runs: mean and spread over seeds, per method, period and aggregate."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import mean, stdev

from chronoscene.bench.results import Failure, RunRecord, read_failures, read_run, run_folders
from chronoscene.errors import CheckpointError
from chronoscene.metrics.names import METRICS, metric_info

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
    Cost("checkpoint_bytes", "checkpoint [MB]", 1e-6, 3),
    Cost("peak_memory_bytes", "peak memory [MB]", 1e-6, 0),
    Cost("peak_device_memory_bytes", "peak GPU memory [MB]", 1e-6, 0),
)


@dataclass(frozen=True, slots=True)
class Group:
    """Runs that differ in the seed only."""

    label: str
    runs: tuple[RunRecord, ...]

    @property
    def first(self) -> RunRecord:
        return self.runs[0]


@dataclass(frozen=True, slots=True)
class Statistic:
    """Mean and spread over seeds."""

    mean: float
    sd: float | None
    """Sample standard deviation (n - 1); None for one seed."""
    n: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Statistic:
        spread = None
        if len(values) > 1:
            spread = stdev(values) if all(map(math.isfinite, values)) else math.nan
        return cls(mean(values), spread, len(values))


@dataclass(frozen=True, slots=True)
class Entry:
    """One number of a table in long form."""

    scene: str
    method: str
    strategy: str
    preset: str
    config_hash: str
    quantity: str
    """Name of a metric, or of a cost in the unit of `RunRecord`."""
    column: str
    """``macro``, ``micro``, ``worst``, ``period <id>``, or empty for costs."""
    mean: float
    sd: float | None
    n: int
    seeds: str
    device: str
    commit: str


@dataclass(frozen=True, slots=True)
class Cell:
    """A number as text, and whether it is the best of its column."""

    text: str
    best: bool = False


@dataclass(frozen=True, slots=True)
class Grid:
    """A table to be printed."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[Cell, ...], ...]


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


def group_runs(records: Iterable[RunRecord]) -> dict[str, list[Group]]:
    """Groups of runs by scene; equal names with other scenes, configs or devices stay apart."""
    by_key: dict[tuple[str, ...], list[RunRecord]] = {}
    for run in records:
        key = (run.scene, _label(run), *_distinctions(run))
        by_key.setdefault(key, []).append(run)
    scenes: dict[str, list[Group]] = {}
    for key, runs in by_key.items():
        alike = [other[2:] for other in by_key if other[:2] == key[:2]]
        differing = [text for i, text in enumerate(key[2:]) if len({a[i] for a in alike}) > 1]
        label = f"{key[1]} [{', '.join(differing)}]" if differing else key[1]
        runs.sort(key=lambda run: run.seed)
        scenes.setdefault(runs[0].scene, []).append(Group(label, tuple(runs)))
    return scenes


def _label(run: RunRecord) -> str:
    return f"{run.title} ({run.strategy}, {run.preset})"


def _distinctions(run: RunRecord) -> tuple[str, ...]:
    """What keeps runs with one label apart, in words."""
    hashes = f"scene {run.scene_hash[:6]}", f"config {run.config_hash[:6]}"
    return (run.method, *hashes, run.device)


def metric_names(records: Iterable[RunRecord], wanted: Sequence[str] = ()) -> list[str]:
    """The metrics to show, in the order of the table of names: those wanted, or all there are."""
    known = [metric_info(name).name for name in wanted]
    there = {name for run in records for name in run.aggregates.get("macro", {})}
    return [name for name in METRICS if name in there and (not known or name in known)]


def period_ids(groups: Iterable[Group]) -> list[str]:
    """Ids of all periods of a scene, in order."""
    return sorted({i for g in groups for run in g.runs for i in run.periods}, key=int)


def statistic(group: Group, metric: str, column: str) -> Statistic | None:
    """Mean over seeds of an aggregate or a period; None where a run lacks the metric."""
    values = []
    for run in group.runs:
        source = run.aggregates.get(column)
        if source is None:
            source = run.periods.get(column.removeprefix("period "), {})
        if metric in source:
            values.append(source[metric])
    return Statistic.of(values) if len(values) == len(group.runs) else None


def cost(group: Group, name: str) -> Statistic | None:
    """Mean over seeds of a cost; None where a run does not know it."""
    values = [getattr(run, name) for run in group.runs]
    return None if None in values else Statistic.of([float(value) for value in values])


def entries(records: Sequence[RunRecord], wanted: Sequence[str] = ()) -> list[Entry]:
    """All numbers in long form: what CSV and JSON hold."""
    found = []
    for groups in group_runs(records).values():
        columns = [f"period {i}" for i in period_ids(groups)] + list(AGGREGATES)
        for group in groups:
            for metric in metric_names(group.runs, wanted):
                values = [(column, statistic(group, metric, column)) for column in columns]
                found += [_entry(group, metric, c, v) for c, v in values if v is not None]
            costs = [(c.name, cost(group, c.name)) for c in COSTS]
            found += [_entry(group, name, "", v) for name, v in costs if v is not None]
    return found


def _entry(group: Group, quantity: str, column: str, value: Statistic) -> Entry:
    run = group.first
    return Entry(
        scene=run.scene,
        method=run.method,
        strategy=run.strategy,
        preset=run.preset,
        config_hash=run.config_hash,
        quantity=quantity,
        column=column,
        mean=value.mean,
        sd=value.sd,
        n=value.n,
        seeds=" ".join(str(r.seed) for r in group.runs),
        device=run.device,
        commit=" ".join(dict.fromkeys(r.commit for r in group.runs)),
    )


def grids(records: Sequence[RunRecord], wanted: Sequence[str] = ()) -> list[Grid]:
    """Per scene a table of each metric and one of costs; a summary where there are more scenes."""
    scenes = group_runs(records)
    made = []
    for scene, groups in scenes.items():
        made += [quality_grid(scene, groups, name) for name in metric_names(records, wanted)]
        made.append(cost_grid(scene, groups))
    if len(scenes) > 1:
        made += [summary_grid(scenes, name) for name in metric_names(records, wanted)]
    return made


def quality_grid(scene: str, groups: Sequence[Group], metric: str) -> Grid:
    """One metric on one scene: methods by periods and aggregates."""
    info, ids = metric_info(metric), period_ids(groups)
    labels = groups[0].first.period_labels
    columns = [f"period {i}" for i in ids] + list(AGGREGATES)
    values = [[statistic(group, metric, column) for column in columns] for group in groups]
    header = ("method", *(_period_title(i, labels) for i in ids), *AGGREGATES, "n")
    arrow = "higher" if info.higher_is_better else "lower"
    title = f"{scene}: {info.title} ({metric}), {arrow} is better"
    cells = format_columns(values, info.decimals, info.higher_is_better)
    cells = [[*row, Cell(str(len(g.runs)))] for row, g in zip(cells, groups, strict=True)]
    return Grid(title, header, _with_labels([g.label for g in groups], cells))


def _period_title(period: str, labels: dict[str, str]) -> str:
    label = labels.get(period, period)
    return f"period {period}" if label == period else f"{period}: {label}"


def cost_grid(scene: str, groups: Sequence[Group]) -> Grid:
    """What the runs on one scene cost."""
    shown = [c for c in COSTS if any(cost(group, c.name) is not None for group in groups)]
    cells = [
        [Cell(format_statistic(cost(group, c.name), c.decimals, c.factor)) for c in shown]
        + [Cell(" ".join(str(run.seed) for run in group.runs))]
        for group in groups
    ]
    header = ("method", *(c.title for c in shown), "seeds")
    return Grid(f"{scene}: cost", header, _with_labels([g.label for g in groups], cells))


def summary_grid(scenes: dict[str, list[Group]], metric: str) -> Grid:
    """Macro means of one metric: methods by scenes, and their mean where no scene is missing."""
    info = metric_info(metric)
    labels = list(dict.fromkeys(g.label for groups in scenes.values() for g in groups))
    values: list[list[Statistic | None]] = []
    for label in labels:
        row = [
            next((statistic(g, metric, "macro") for g in groups if g.label == label), None)
            for groups in scenes.values()
        ]
        known = [value.mean for value in row if value is not None]
        complete = len(known) == len(scenes)
        values.append([*row, Statistic(mean(known), None, 1) if complete else None])
    header = ("method", *scenes, "mean of scenes")
    cells = format_columns(values, info.decimals, info.higher_is_better)
    return Grid(f"all scenes: {info.title} ({metric}), macro", header, _with_labels(labels, cells))


def _with_labels(labels: Sequence[str], cells: list[list[Cell]]) -> tuple[tuple[Cell, ...], ...]:
    return tuple((Cell(label), *row) for label, row in zip(labels, cells, strict=True))


def format_columns(
    values: Sequence[Sequence[Statistic | None]],
    decimals: int,
    higher_is_better: bool,
) -> list[list[Cell]]:
    """Format rows of numbers and mark the best of each column, if there is a choice."""
    best: list[float | None] = [None] * len(values[0])
    if len(values) > 1:
        pick = max if higher_is_better else min
        for i in range(len(best)):
            known = (row[i] for row in values)
            best[i] = pick((round(v.mean, decimals) for v in known if v is not None), default=None)
    return [
        [
            # What reads the same in the table is marked alike.
            Cell(
                format_statistic(v, decimals), v is not None and round(v.mean, decimals) == best[i]
            )
            for i, v in enumerate(row)
        ]
        for row in values
    ]


def format_statistic(value: Statistic | None, decimals: int, factor: float = 1.0) -> str:
    """``mean`` or ``mean ± sd``; a dash where there is no number."""
    if value is None:
        return "-"
    text = f"{value.mean * factor:.{decimals}f}"
    if value.sd is None:
        return text
    return f"{text} ± {value.sd * factor:.{decimals}f}"


def footnotes(
    records: Sequence[RunRecord], failures: Sequence[Failure], wanted: Sequence[str] = ()
) -> list[str]:
    """What a reader must know: aggregates, spread, device, code, what is absent and why."""
    notes = ["macro: mean over periods; micro: mean over test views; worst: the worst period"]
    if any(len(g.runs) > 1 for groups in group_runs(records).values() for g in groups):
        notes.append("±: sample standard deviation over n seeds")
    for name, title in (("device", "device"), ("commit", "code")):
        values = dict.fromkeys(str(getattr(run, name)) for run in records)
        if values:
            notes.append(f"{title}: {'; '.join(values)}")
    absent: dict[str, list[str]] = {}
    for run in records:
        for metric, reason in run.skipped.items():
            names = absent.setdefault(reason, [])
            if metric not in names and (not wanted or metric in wanted):
                names.append(metric)
    notes += [f"absent: {', '.join(names)}: {reason}" for reason, names in absent.items() if names]
    notices = dict.fromkeys(notice for run in records for notice in run.notices)
    seeds: dict[tuple[str, str], list[str]] = {}
    for f in failures:
        name = f"{f.scene}, {f.method} ({f.strategy}, {f.preset})"
        seeds.setdefault((name, f.reason), []).append(str(f.seed))
    failed = [f"failed: {n}, seed {', '.join(s)}: {reason}" for (n, reason), s in seeds.items()]
    return [*notes, *notices, *failed]
