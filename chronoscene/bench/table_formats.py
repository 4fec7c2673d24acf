"""Tables as text for a terminal, Markdown, LaTeX, CSV or JSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import asdict, fields
from typing import Any

from chronoscene.bench.results import Failure, RunRecord
from chronoscene.bench.run_folders import csv_text
from chronoscene.bench.tables import Cell, Entry, Grid, entries, footnotes, grids

FORMATS = ("table", "csv", "markdown", "latex", "json")


def format_runs(
    records: Sequence[RunRecord],
    failures: Sequence[Failure],
    style: str,
    metrics: Sequence[str] = (),
) -> str:
    """All tables of some runs in one of `FORMATS`."""
    if style == "csv":
        columns = [f.name for f in fields(Entry)]
        rows = [list(asdict(entry).values()) for entry in entries(records, metrics)]
        return csv_text(columns, rows)
    notes = footnotes(records, failures, metrics)
    if style == "json":
        found = [_json_safe(asdict(entry)) for entry in entries(records, metrics)]
        return json.dumps({"entries": found, "notes": notes}, indent=1, allow_nan=False) + "\n"
    made = grids(records, metrics)
    if style == "markdown":
        return "\n\n".join([*map(markdown, made), "\n".join(f"- {n}" for n in notes)]) + "\n"
    if style == "latex":
        return "\n\n".join([*map(latex, made), "\n".join(f"% {n}" for n in notes)]) + "\n"
    return "\n\n".join([*map(plain, made), "\n".join(notes)]) + "\n"


def _json_safe(entry: dict[str, Any]) -> dict[str, Any]:
    """Numbers that JSON lacks become the strings ``Infinity`` and ``NaN``."""
    return {key: _spell(value) for key, value in entry.items()}


def _spell(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else ("Infinity" if value > 0 else "-Infinity")
    return value


def plain(grid: Grid) -> str:
    """Aligned columns; ``*`` marks the best of a column."""
    rows = [[_starred(cell) for cell in row] for row in grid.rows]
    widths = [max(map(len, column)) for column in zip(grid.header, *rows, strict=True)]
    lines = [grid.title, _aligned(grid.header, widths), "  ".join("-" * w for w in widths)]
    return "\n".join([*lines, *(_aligned(row, widths) for row in rows)])


def _starred(cell: Cell) -> str:
    return f"{cell.text} *" if cell.best else cell.text


def _aligned(row: Sequence[str], widths: Sequence[int]) -> str:
    first, *rest = (
        text.ljust(w) if i == 0 else text.rjust(w)
        for i, (text, w) in enumerate(zip(row, widths, strict=True))
    )
    return "  ".join([first, *rest]).rstrip()


def markdown(grid: Grid) -> str:
    """A pipe table under a heading; the best of a column in bold."""
    lines = [
        f"**{_markdown_text(grid.title)}**",
        "",
        _piped([_markdown_text(text) for text in grid.header]),
        _piped(["---", *["---:"] * (len(grid.header) - 1)]),
    ]
    for row in grid.rows:
        texts = [_markdown_text(cell.text) for cell in row]
        lines.append(_piped([f"**{t}**" if c.best else t for t, c in zip(texts, row, strict=True)]))
    return "\n".join(lines)


def _piped(row: Sequence[str]) -> str:
    return f"| {' | '.join(row)} |"


def _markdown_text(text: str) -> str:
    return re.sub(r"([\\|*_<>`])", r"\\\1", text)


def latex(grid: Grid) -> str:
    """A tabular for the booktabs package; the best of a column in bold."""
    lines = [
        f"% {grid.title}",
        rf"\begin{{tabular}}{{l{'r' * (len(grid.header) - 1)}}}",
        r"\toprule",
        _latex_row([latex_text(text) for text in grid.header]),
        r"\midrule",
    ]
    for row in grid.rows:
        texts = [latex_text(cell.text) for cell in row]
        bold = [rf"\textbf{{{t}}}" if c.best else t for t, c in zip(texts, row, strict=True)]
        lines.append(_latex_row(bold))
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def _latex_row(row: Sequence[str]) -> str:
    return rf"{' & '.join(row)} \\"


def latex_text(text: str) -> str:
    """Text with LaTeX's special characters escaped."""
    special = {"\\": r"\textbackslash{}", "~": r"\textasciitilde{}", "^": r"\textasciicircum{}"}
    escaped = re.sub(r"[\\~^]|[&%$#_{}]", lambda m: special.get(m[0], "\\" + m[0]), text)
    return escaped.replace("±", r"$\pm$")
