"""The full table: one row per period and scene with everything that was measured."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

from chronoscene.stats.counts import escape_latex, plain_text, totals
from chronoscene.stats.measures import Measures, SceneStatistics

MOST_SHOWN = 8
"""Periods up to which the overlaps fit into a table for reading; CSV and JSON have them all."""


@dataclass(frozen=True, slots=True)
class Column:
    """One measured quantity."""

    name: str
    """In CSV; a field of `Measures`, or of the counts."""
    head: tuple[str, str]
    """Two lines."""
    factor: float = 1.0
    """From the stored value to the shown one."""
    decimals: int = 0

    def show(self, value: float | None) -> str:
        return "-" if value is None else f"{self.factor * value:,.{self.decimals}f}"


COLUMNS = (
    Column("images", ("Images", "")),
    Column("test", ("of these", "test")),
    Column("points", ("Points", "")),
    Column("observations", ("Observations", "")),
    Column("track_mean", ("Track", "mean"), decimals=2),
    Column("track_median", ("", "median"), decimals=1),
    Column("reprojection_error", ("Error", "[px]"), decimals=3),
    Column("baseline", ("Baseline", "[% of depth]"), factor=100.0, decimals=1),
    Column("coverage", ("Coverage", "[%]"), factor=100.0, decimals=1),
)


@dataclass(frozen=True, slots=True)
class Row:
    """One period, or a whole scene."""

    scene: str
    period: int | None
    """None for the whole scene."""
    label: str
    date: str | None
    values: dict[str, float | None]
    """By the names of `COLUMNS`."""
    overlap: tuple[float | None, ...]
    """With each period; empty for the whole scene."""

    @property
    def title(self) -> str:
        if self.period is None:
            return "all"
        known = self.label != str(self.period)
        return f"{self.period}: {self.label}" if known else self.label


def rows_of(statistics: SceneStatistics) -> list[Row]:
    """A row for each period and one for the scene."""
    counts = statistics.counts
    rows = []
    for count, measures, overlap in zip(
        counts.periods, statistics.periods, statistics.overlap, strict=True
    ):
        values = _values(count.images, count.test, count.points, measures)
        rows.append(Row(counts.name, count.id, count.label, count.date, values, overlap))
    tests = sum(count.test for count in counts.periods)
    values = _values(counts.images, tests, counts.points, statistics.whole)
    return [*rows, Row(counts.name, None, "all", None, values, ())]


def _values(images: int, test: int, points: int, measures: Measures) -> dict[str, float | None]:
    return {"images": images, "test": test, "points": points, **asdict(measures)}


def _most_periods(statistics: Sequence[SceneStatistics]) -> int:
    return max((len(s.periods) for s in statistics), default=0)


def details_csv(statistics: Sequence[SceneStatistics]) -> str:
    """One line per row in the stored units; empty cells where there is no value."""
    periods = _most_periods(statistics)
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    overlaps = [f"overlap_{i}" for i in range(periods)]
    writer.writerow(["scene", "period", "label", "date", *(c.name for c in COLUMNS), *overlaps])
    for scene in statistics:
        for row in rows_of(scene):
            period = "all" if row.period is None else row.period
            cells = [row.values[c.name] for c in COLUMNS]
            missing = [None] * (periods - len(row.overlap))
            writer.writerow(
                [row.scene, period, row.label, row.date, *cells, *row.overlap, *missing]
            )
    return out.getvalue()


def details_json(statistics: Sequence[SceneStatistics]) -> str:
    """Counts and measures of every period and scene, and the overlaps, in the stored units."""
    data = {
        "scenes": [_scene_item(s) for s in statistics],
        "totals": totals([s.counts for s in statistics]),
    }
    return json.dumps(data, indent=1, ensure_ascii=False) + "\n"


def _scene_item(statistics: SceneStatistics) -> dict[str, Any]:
    item = asdict(statistics.counts) | asdict(statistics.whole)
    periods = zip(item["periods"], statistics.periods, statistics.overlap, strict=True)
    item["periods"] = [
        count | asdict(measures) | {"overlap": list(overlap)}
        for count, measures, overlap in periods
    ]
    return item | {"unit": statistics.unit}


def _grid(statistics: Sequence[SceneStatistics]) -> tuple[list[tuple[str, str]], list[list[str]]]:
    """Heads in two lines, and cells as text."""
    periods = _most_periods(statistics)
    shown = periods if 1 < periods <= MOST_SHOWN else 0
    overlaps = [("Also seen by" if i == 0 else "", f"{i} [%]") for i in range(shown)]
    heads = [("Scene", ""), ("Period", ""), *(c.head for c in COLUMNS), *overlaps]
    lines = []
    for scene in statistics:
        for row in rows_of(scene):
            name = row.scene if row.period == 0 else ""
            cells = [c.show(row.values[c.name]) for c in COLUMNS]
            with_others = [_percent(row, i) for i in range(shown)]
            lines.append([name, row.title, *cells, *with_others])
    return heads, lines


def _percent(row: Row, other: int) -> str:
    if other == row.period:
        return "-"
    value = row.overlap[other] if other < len(row.overlap) else None
    return "" if value is None else f"{100 * value:.1f}"


def details_text(statistics: Sequence[SceneStatistics]) -> str:
    """Table for a terminal, without colours."""
    from rich import box
    from rich.table import Table

    heads, lines = _grid(statistics)
    table = Table(box=box.SIMPLE_HEAD, padding=(0, 1, 0, 0), collapse_padding=True)
    for i, head in enumerate(heads):
        table.add_column("\n".join(head), justify="left" if i < 2 else "right", no_wrap=True)
    for line in lines:
        table.add_row(*line, end_section=line[1] == "all")
    return plain_text(table)


def details_markdown(statistics: Sequence[SceneStatistics]) -> str:
    """Pipe table."""
    heads, lines = _grid(statistics)
    titles = [" ".join(filter(None, head)) for head in heads]
    rule = ["---", "---", *["---:"] * (len(heads) - 2)]
    rows = [[cell.replace("|", "\\|") for cell in line] for line in lines]
    return "".join(f"| {' | '.join(line)} |\n" for line in [titles, rule, *rows])


def details_latex(statistics: Sequence[SceneStatistics]) -> str:
    """A ``tabular`` for the booktabs package."""
    heads, lines = _grid(statistics)
    body = []
    for i, line in enumerate(lines):
        if i and line[0]:
            body.append(r"\midrule")
        body.append(" & ".join(map(escape_latex, line)) + r" \\")
    return "\n".join(
        [
            r"\begin{tabular}{ll" + "r" * (len(heads) - 2) + "}",
            r"\toprule",
            *(" & ".join(escape_latex(head[i]) for head in heads) + r" \\" for i in (0, 1)),
            r"\midrule",
            *body,
            r"\bottomrule",
            r"\end{tabular}",
            "",
        ]
    )


DETAIL_WRITERS: dict[str, Callable[[Sequence[SceneStatistics]], str]] = {
    "table": details_text,
    "csv": details_csv,
    "markdown": details_markdown,
    "latex": details_latex,
    "json": details_json,
}
"""Output format to the function that writes it."""
