"""The table of a study: measured beside published figures, and their agreement."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from chronoscene.harness.files.records import Failure, RunRecord
from chronoscene.harness.report.comparable import apart, with_own_titles
from chronoscene.harness.report.summary import (
    DIFFERENCE,
    ENTRY_COLUMNS,
    MEASURED,
    PAPER_METRICS,
    SIZE,
    compare_with,
    in_unit,
    summarise,
)
from chronoscene.harness.report.tables import COST_TITLES, footnotes, interval_text, json_entry
from chronoscene.harness.score.scoring import read_scored
from chronoscene.harness.study.plan import Study
from chronoscene.io import tables
from chronoscene.io.tables import Head, Table
from chronoscene.metrics.registry import all_metrics, metric_info

if TYPE_CHECKING:
    from pandas import DataFrame

COLUMNS = ("row", *ENTRY_COLUMNS)
"""Columns of CSV and JSON: ``row`` is the label in the study, and differences are to its first row.
Published figures are rows of their own, with the publication as ``source`` and its ``scene``."""

AGREES = "agrees with the published one"
DISAGREES = "disagrees with the published one"
UNDECIDED = "cannot be determined"


def study_entries(study: Study, runs: Mapping[str, Sequence[RunRecord]]) -> DataFrame:
    """Summarise the rows of a study: measured macro means and costs, and published figures.

    Args:
        study: The study.
        runs: Finished runs, with the values of their views, by the label of their row.

    Returns:
        `COLUMNS` and the columns that `summarise` adds.
    """
    import pandas as pd

    parts = [summarise(runs[row.label]).assign(row=row.label) for row in study.rows]
    measured = pd.concat([part for part in parts if len(part)], ignore_index=True)
    measured = measured[measured.column.isin(("macro", ""))].assign(tied=False)
    first = study.rows[0].label
    for _, part in measured.groupby(["scene", "quantity"], sort=False):
        reference, others = part.index[part.row == first], part.index[part.row != first]
        if len(reference) and len(others):
            compare_with(measured, reference[0], others, chosen=False)
    return pd.concat([measured, _published(study)], ignore_index=True)


def _published(study: Study) -> DataFrame:
    """Return entries of the published figures."""
    import pandas as pd

    known = study.rows[0].published
    entries = [
        {
            "row": row.label,
            "scene": scene,
            "quantity": quantity,
            "mean": value,
            "column": "macro" if quantity in all_metrics() else "",
            "difference": value - known.get(scene, {}).get(quantity, math.nan),
        }
        for row in study.rows
        for scene, figures in row.published.items()
        for quantity, value in figures.items()
    ]
    columns = ("row", "scene", "quantity", "column", "mean", "difference")
    unknown = dict.fromkeys(("sd", "low", "high", *DIFFERENCE[1:]), math.nan)
    texts = ("method", "strategy", "preset", "variant", "config_hash", "seeds", "device", "commit")
    return pd.DataFrame(entries, columns=columns).assign(
        source=study.source, n=1, tied=False, **unknown, **dict.fromkeys(texts, "")
    )


def _quantities(study: Study, entries: DataFrame) -> list[str]:
    """Return the quantities of the table: metrics of papers, size, other published ones."""
    there = set(entries[entries.source == MEASURED].quantity)
    printed = {name for row in study.rows for figures in row.published.values() for name in figures}
    wanted = {*PAPER_METRICS, SIZE, *printed}
    return [name for name in (*all_metrics(), *COST_TITLES) if name in there & wanted]


def study_table(study: Study, entries: DataFrame) -> Table:
    """Return a table of means, differences to the first row with intervals, and published figures.

    Args:
        study: The study.
        entries: Result of `study_entries`.
    """
    measured = entries[entries.source == MEASURED]
    by_key = {
        (entry["source"], entry["scene"], entry["row"], entry["quantity"]): entry
        for entry in entries.to_dict("records")
    }
    labels = [(scene, row.label) for scene in measured.scene.unique() for row in study.rows]
    heads: list[Head] = ["scene", "row"]
    columns = []
    for quantity in _quantities(study, entries):
        metric = quantity in all_metrics()
        title = metric_info(quantity).title if metric else COST_TITLES[quantity]
        found = [by_key.get((MEASURED, scene, label, quantity)) for scene, label in labels]
        heads.append((title, "measured"))
        columns.append([entry["text"] if entry else "-" for entry in found])
        if metric:
            heads.append(("", "difference"))
            columns.append([_difference(entry) for entry in found])
        printed = entries[(entries.source != MEASURED) & (entries.quantity == quantity)]
        for place in printed.scene.unique():
            heads.append(("", f"{place} (published)"))
            known = [by_key.get((study.source, place, label, quantity)) for _, label in labels]
            columns.append([_printed(entry) for entry in known])
    heads.append("seeds")
    seeds = {(e["scene"], e["row"]): e["seeds"] for e in measured.to_dict("records")}
    columns.append([seeds.get(label, "-") for label in labels])
    rows = [[*label, *cells] for label, *cells in zip(labels, *columns, strict=True)]
    breaks = range(len(study.rows) - 1, len(rows) - 1, len(study.rows))
    return Table(heads, rows, labels=2, title=study.title, breaks=breaks)


def _difference(entry: Mapping[Any, Any] | None) -> str:
    known = entry is not None and not math.isnan(entry["difference"])
    return interval_text(entry, "difference_") if entry and known else "-"


def _printed(entry: Mapping[Any, Any] | None) -> str:
    if entry is None:
        return "-"
    number, difference = in_unit(entry["quantity"], entry["mean"]), entry["difference"]
    if not difference or math.isnan(difference):
        return number
    sign = "+" if difference > 0 else "\N{MINUS SIGN}"
    return f"{number} ({sign}{in_unit(entry['quantity'], abs(difference))})"


def directions(study: Study, entries: DataFrame) -> list[str]:
    """Return a sentence for each scene and row but the first, by `direction`.

    There is none if nothing is published of any row.
    """
    if not _is_published(study):
        return []
    is_measured = entries.source == MEASURED
    metrics = [name for name in _quantities(study, entries) if name in all_metrics()]
    sentences = []
    for scene in entries[is_measured].scene.unique():
        here = is_measured & (entries.scene == scene)
        for row in study.rows[1:]:
            verdicts: dict[str, list[str]] = {}
            for metric in metrics:
                mine = (entries.row == row.label) & (entries.quantity == metric)
                printed = entries[mine & ~is_measured].difference.dropna().tolist()
                found = entries[mine & here].to_dict("records")
                if printed:
                    verdict = direction(found[0], printed) if found else f"{UNDECIDED} (no result)"
                    verdicts.setdefault(verdict, []).append(metric_info(metric).title)
            said = [f"in {', '.join(t)} the direction {v}" for v, t in verdicts.items()]
            text = "; ".join(said) or "nothing is published to compare with"
            sentences.append(f"{scene}, {row.label}: {text}.")
    return sentences


def _is_published(study: Study) -> bool:
    return any(row.published for row in study.rows)


def direction(entry: Mapping[Any, Any], published: Sequence[float]) -> str:
    """Compare the sign of a measured difference with the published ones.

    Args:
        entry: The measured difference, with its interval.
        published: Published differences of the same quantity.
    """
    low, high = entry["difference_low"], entry["difference_high"]
    if not (min(published) > 0 or max(published) < 0):
        return f"{UNDECIDED} (the published scenes do not agree)"
    if math.isnan(low):
        return f"{UNDECIDED} (there is no interval)"
    if abs(entry["difference"]) <= entry["by_seeds"]:
        explained = in_unit(entry["quantity"], entry["by_seeds"])
        return f"{UNDECIDED} (seeds alone explain differences up to {explained})"
    if low <= 0 <= high:
        return f"{UNDECIDED} (the interval contains 0)"
    return AGREES if (entry["difference"] > 0) == (published[0] > 0) else DISAGREES


def study_texts(
    study: Study,
    finished: Mapping[str, Sequence[Path]],
    failures: Sequence[Failure],
    *,
    width: int | None = None,
) -> dict[str, str]:
    """Format the outcome of a study in every format.

    Args:
        study: The study.
        finished: Folders of its finished runs by the label of their row; one at least.
        failures: Runs that failed.
        width: Width of the terminal.

    Returns:
        ``table`` (for a terminal), ``markdown``, ``csv`` and ``json``.
    """
    found = [read_scored(path) for paths in finished.values() for path in paths]
    records = apart(with_own_titles(found))
    runs = {label: [r for r in records if r.folder in paths] for label, paths in finished.items()}
    entries = study_entries(study, runs)
    table, sentences = study_table(study, entries), directions(study, entries)
    printed = "; for published figures in parentheses" if _is_published(study) else ""
    notes = [
        f"difference: to {study.rows[0].label!r}, with its 95 % interval{printed}",
        *([f"published: {study.source}"] if study.source else []),
        *study.notes,
    ]
    measured = entries[entries.source == MEASURED].assign(tied=False)
    notes += footnotes(measured, records, failures, macro_only=True)
    listed = entries[[*COLUMNS]]
    document = {
        "title": study.title,
        "question": study.question,
        "entries": [json_entry(entry) for entry in listed.to_dict("records")],
        "directions": sentences,
        "notes": notes,
    }
    lines = "".join(f"{line}\n" for line in (*sentences, "", *notes))
    return {
        "table": f"{study.question}\n\n{tables.boxed_text(table, width=width)}\n{lines}",
        "markdown": f"{study.question}\n\n{tables.markdown(table)}\n"
        + tables.markdown_list([*sentences, *notes]),
        "csv": str(listed.to_csv(index=False, lineterminator="\n")),
        "json": json.dumps(document, indent=1, allow_nan=False) + "\n",
    }
