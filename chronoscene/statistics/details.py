"""The full table: one row per period and scene with everything that was measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from chronoscene.io import tables
from chronoscene.io.tables import Head, Table
from chronoscene.statistics.counts import Unreadable, compared, document, period_title
from chronoscene.statistics.measures import SceneStatistics

MAX_SHOWN = 8
"""Periods up to which the overlaps fit into a table for reading; CSV and JSON have them all."""


@dataclass(frozen=True, slots=True)
class DetailColumn:
    """One measured quantity."""

    name: str
    """In CSV; a field of `Measures`, or of the counts."""
    head: Head
    factor: float = 1.0
    """From the stored value to the shown one."""
    decimals: int = 0

    def show(self, value: float | None) -> str:
        return "-" if value is None else f"{self.factor * value:,.{self.decimals}f}"


COLUMNS = (
    DetailColumn("images", "Images"),
    DetailColumn("test", ("", "test")),
    DetailColumn("points", "Points"),
    DetailColumn("points_seen", ("", "seen")),
    DetailColumn("observations", "Observations"),
    DetailColumn("track_mean", ("Track", "mean"), decimals=2),
    DetailColumn("track_median", ("", "median"), decimals=1),
    DetailColumn("reprojection_error", ("Error", "[px]"), decimals=3),
    DetailColumn("baseline", ("Baseline", "[% of depth]"), factor=100.0, decimals=1),
    DetailColumn("coverage", ("Coverage", "[%]"), factor=100.0, decimals=1),
)


@dataclass(frozen=True, slots=True)
class DetailRow:
    """One period, or a whole scene."""

    scene: str
    period: int | None
    """None for the whole scene."""
    label: str
    date: str | None
    values: dict[str, Any]
    """By the names of `COLUMNS`, and more."""
    overlap: tuple[float | None, ...]
    """Overlap with each period; empty for the whole scene."""
    in_view: tuple[float | None, ...]
    """Share in view of each period; empty for the whole scene."""

    @property
    def title(self) -> str:
        return "all" if self.period is None else period_title(self.period, self.label, self.date)


def rows_of(statistics: SceneStatistics) -> list[DetailRow]:
    """Make a row for each period and one for the scene."""
    counts = statistics.counts
    shares = zip(statistics.overlap, statistics.in_view, strict=True)
    rows = [
        DetailRow(
            counts.name, count.id, count.label, count.date, asdict(count) | asdict(own), *known
        )
        for count, own, known in zip(counts.periods, statistics.periods, shares, strict=True)
    ]
    tests = sum(count.test for count in counts.periods)
    whole = {"images": counts.images, "test": tests, "points": counts.points}
    return [
        *rows,
        DetailRow(counts.name, None, "all", None, whole | asdict(statistics.whole), (), ()),
    ]


def format_details(
    statistics: Sequence[SceneStatistics],
    style: str,
    *,
    width: int | None = None,
    unreadable: Sequence[Unreadable] = (),
) -> str:
    """Format everything that was measured in one of `chronoscene.io.tables.FORMATS`.

    CSV and JSON are in the stored units. Arguments as in `counts.format_counts`.
    """
    if style == "json":
        scenes = [_scene_item(s) for s in statistics]
        return document(scenes, [s.counts for s in statistics], unreadable)
    if style == "csv":
        return _csv(statistics)
    return tables.text_of(_table(statistics), style, width=width)


def _csv(statistics: Sequence[SceneStatistics]) -> str:
    """Format one line per row, with empty cells where there is no value.

    The number of the period is empty for a whole scene, so that the column is of numbers.
    """
    periods = max((len(s.periods) for s in statistics), default=0)
    shares = [f"{what}_{i}" for what in ("overlap", "in_view") for i in range(periods)]
    lines = []
    for row in (row for scene in statistics for row in rows_of(scene)):
        cells = [row.values[c.name] for c in COLUMNS]
        for known in (row.overlap, row.in_view):
            cells += [*known, *[None] * (periods - len(known))]
        lines.append([row.scene, row.period, row.label, row.date, *cells])
    columns = ["scene", "period", "label", "date", *(c.name for c in COLUMNS), *shares]
    return tables.csv_text(columns, lines)


def _scene_item(statistics: SceneStatistics) -> dict[str, Any]:
    item = asdict(statistics.counts) | asdict(statistics.whole)
    periods = zip(
        item["periods"], statistics.periods, statistics.overlap, statistics.in_view, strict=True
    )
    item["periods"] = [
        count | asdict(measures) | {"overlap": list(overlap), "in_view": list(in_view)}
        for count, measures, overlap, in_view in periods
    ]
    return item | {"unit": statistics.unit, "paper": compared(statistics.counts)}


def _table(statistics: Sequence[SceneStatistics]) -> Table:
    """Make the table for readers, with a rule after each scene but the last."""
    periods = max((len(s.periods) for s in statistics), default=0)
    shown = periods if 1 < periods <= MAX_SHOWN else 0
    titles = [
        (title if i == 0 else "", f"{i} [%]")
        for title in ("Also seen by", "In view of")
        for i in range(shown)
    ]
    heads = ["Scene", "Period", *(c.head for c in COLUMNS), *titles]
    rows = [row for scene in statistics for row in rows_of(scene)]
    lines = []
    for row in rows:
        cells = [c.show(row.values[c.name]) for c in COLUMNS]
        for shares in (row.overlap, row.in_view):
            cells += [_percent(row, shares, i) for i in range(shown)]
        lines.append([row.scene if row.period == 0 else "", row.title, *cells])
    breaks = [i for i, row in enumerate(rows[:-1]) if row.period is None]
    return Table(heads, lines, labels=2, breaks=breaks)


def _percent(row: DetailRow, shares: tuple[float | None, ...], other: int) -> str:
    if other >= len(shares):
        return ""
    value = None if other == row.period else shares[other]
    return "-" if value is None else f"{100 * value:.1f}"
