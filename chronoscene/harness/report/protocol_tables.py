"""Printed tables of other datasets, beside runs under their protocols."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from statistics import fmean

from chronoscene.harness.files.protocols import PROTOCOLS
from chronoscene.harness.files.records import RunRecord
from chronoscene.harness.report.published import PublishedTable
from chronoscene.harness.report.summary import MEASURED, labelled
from chronoscene.io.tables import Table
from chronoscene.metrics.registry import metric_info


@dataclass(frozen=True, slots=True)
class ProtocolRow:
    """One method on the data of a protocol."""

    protocol: str
    method: str
    source: str
    """``measured``, or a publication."""
    scenes: int | None
    """Number of scenes; None where nothing is printed about it."""
    values: dict[str, float | None]
    """By metric: the mean over all test views of a scene, then over seeds and scenes."""


def protocol_rows(published: PublishedTable, records: Sequence[RunRecord]) -> list[ProtocolRow]:
    """Return the rows of all protocols that runs were made under: measured ones, then printed."""
    names = dict.fromkeys(run.protocol for run in records if run.protocol in PROTOCOLS)
    return [
        row for name in names for row in (*_measured(name, records), *_printed(name, published))
    ]


def _measured(name: str, records: Sequence[RunRecord]) -> Iterator[ProtocolRow]:
    groups: dict[str, dict[str, list[RunRecord]]] = {}
    runs = [run for run in records if run.protocol == name]
    for run, label in zip(runs, labelled(runs).label, strict=True):
        scenes = groups.setdefault(label, {})
        scenes.setdefault(run.scene_hash, []).append(run)  # one may have several names
    for label, scenes in groups.items():
        values: dict[str, float | None] = {}
        for metric in PROTOCOLS[name].metrics:
            micro = [[run.aggregates["micro"].get(metric) for run in s] for s in scenes.values()]
            known = [[v for v in of_scene if v is not None] for of_scene in micro]
            values[metric] = fmean(map(fmean, known)) if all(known) else None
        yield ProtocolRow(name, label, MEASURED, len(scenes), values)


def _printed(name: str, published: PublishedTable) -> Iterator[ProtocolRow]:
    metrics = PROTOCOLS[name].metrics
    table = next(table for table in published.tables if table.id == PROTOCOLS[name].table)
    for method, *numbers in table.rows:
        values = {m: float(v) for m, v in zip(metrics, numbers, strict=True) if v is not None}
        yield ProtocolRow(
            name, f"{method} (published)", published.title, None,
            {metric: values.get(metric) for metric in metrics},
        )  # fmt: skip


def protocol_tables(rows: Sequence[ProtocolRow]) -> list[Table]:
    """Make a table for each protocol."""
    return [_table(name, [r for r in rows if r.protocol == name])
            for name in dict.fromkeys(row.protocol for row in rows)]  # fmt: skip


def _table(name: str, rows: Sequence[ProtocolRow]) -> Table:
    infos = [metric_info(metric) for metric in PROTOCOLS[name].metrics]
    cells = []
    for row in rows:
        found = [(row.values[info.name], info.decimals) for info in infos]
        texts = ["-" if value is None else f"{value:.{digits}f}" for value, digits in found]
        cells.append([row.method, *texts, "-" if row.scenes is None else str(row.scenes)])
    heads = ["method", *(info.title for info in infos), "scenes"]
    title = f"{PROTOCOLS[name].title} (--protocol {name}): means over all test views of a scene"
    breaks = {sum(row.source == MEASURED for row in rows) - 1}
    return Table(heads, cells, title=title, breaks=breaks)
