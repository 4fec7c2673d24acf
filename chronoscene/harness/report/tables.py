"""Tables of runs: an overview as papers print it, each metric by period, and what runs cost."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, replace
from typing import TYPE_CHECKING, Any, NamedTuple

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import UNTRAINED, Failure, RunRecord
from chronoscene.harness.files.strategies import period_part
from chronoscene.harness.report.comparable import effort_of, scene_of, several_scenes
from chronoscene.harness.report.protocol_tables import protocol_rows, protocol_tables
from chronoscene.harness.report.summary import (
    AGGREGATES,
    COSTS,
    ENTRY_COLUMNS,
    MEASURED,
    PAPER_METRICS,
    SHARING,
    SIZE,
    TIMES,
    TRANSFERS,
    in_unit,
    kind_of,
    metric_names,
    over_scenes,
    published_entries,
    summarise,
)
from chronoscene.io import tables
from chronoscene.io.tables import Head, Table
from chronoscene.io.wording import counted, printable
from chronoscene.metrics.registry import all_metrics, metric_info

if TYPE_CHECKING:
    from pandas import DataFrame

    from chronoscene.harness.report.published import PublishedTable

MAX_PERIODS = 8
"""Periods that have columns beside the aggregates, and that stand in one table."""
MAX_SCENES = 7
"""Scenes in one table of the overview; the paper has six and their mean."""
FEW_VIEWS = 8
"""Notes name the test views of a period if there are fewer."""
ALL_SCENES = "mean of scenes"
COST_TITLES = {cost.name: cost.title for cost in COSTS}


def format_runs(
    records: Sequence[RunRecord],
    failures: Sequence[Failure],
    style: str,
    metrics: Sequence[str] = (),
    *,
    published: PublishedTable | None = None,
    periods: bool = False,
    renames: Mapping[str, str] | None = None,
    columns: Sequence[str] = (),
    width: int | None = None,
) -> str:
    """Format all tables of some runs in one of `chronoscene.io.tables.FORMATS`.

    Args:
        records: Finished runs of any scenes, as from `read_runs` in `summary`.
        failures: Runs that failed, for the notes.
        style: The format.
        metrics: Names of those wanted, without costs; none for all, and costs.
        published: Printed numbers to show beside the runs in the overview.
        periods: Show every period of scenes with more than `MAX_PERIODS`, too.
        renames: Parts of the names of methods, and what to write instead.
        columns: Heads of columns to show, with or without their unit; none for all.
        width: Characters of the terminal that ``table`` goes to; None for no limit.
    """
    import pandas as pd

    entries = summarise(records, metrics)
    if published is not None:
        scenes = dict.fromkeys(run.scene for run in records)
        printed = published_entries(published, scenes)
        wanted = printed.quantity.isin(metrics) if metrics else slice(None)
        entries = pd.concat([entries, printed[wanted]])
    names = _renamed(entries.label.unique(), renames)
    entries = entries.assign(label=entries.label.map(names))
    listed = entries[entries.quantity.isin(metrics)] if metrics else entries
    if style == "csv":
        # NaN is a spread that is not defined, an empty cell that there is none.
        sds = zip(listed.n, listed.sd, strict=True)
        listed = listed.assign(sd=["" if n == 1 else repr(sd) for n, sd in sds])
        return str(listed.to_csv(columns=ENTRY_COLUMNS, index=False, lineterminator="\n"))
    notes = footnotes(entries, records, failures, metrics)
    beside = []
    if published is not None:
        notes += published_notes(published, records)
        beside = [
            replace(row, method=names.get(row.method, row.method))
            for row in protocol_rows(published, records)
        ]
    if style == "json":
        found = [json_entry(entry) for entry in listed[[*ENTRY_COLUMNS]].to_dict("records")]
        document: dict[str, Any] = {"entries": found, "notes": notes}
        if beside:
            document["protocols"] = [asdict(row) for row in beside]
        return json.dumps(document, indent=1, allow_nan=False) + "\n"
    made = protocol_tables(beside) + readable_tables(entries, records, metrics, periods=periods)
    made = with_columns(made, columns) if columns else made
    return tables_text(made, notes, style, width=width)


def _renamed(labels: Iterable[str], renames: Mapping[str, str] | None) -> dict[str, str]:
    """Return new names of methods by the old ones."""
    names = {label: label for label in labels}
    for old, new in (renames or {}).items():
        changed = {label: name.replace(old, new) for label, name in names.items()}
        if changed == names or len({*changed.values()}) < len(changed) or "" in changed.values():
            raise ConfigError(
                f"--rename {old}={new}",
                expected="a part of one of the names"
                if changed == names
                else "names that still differ afterwards",
                found=f"the names {', '.join(map(repr, names.values()))}",
                todo="correct OLD, or choose another NEW",
            )
        names = changed
    return names


def with_columns(made: Iterable[Table], names: Sequence[str]) -> list[Table]:
    """Keep the columns with some heads; tables without any are left out.

    Raises:
        ConfigError: If a name is the head of no column.
    """
    kept, known = list[Table](), set[str]()
    for table in made:
        chosen, heads, group, last = [*range(table.labels)], [*table.heads[: table.labels]], "", ""
        for j, (first, second) in [*enumerate(table.head_lines)][table.labels :]:
            group = first or group
            texts = {text for text in (group, second, table.flat_heads[j]) if text}
            texts |= {text.partition(" [")[0] for text in texts}  # without the unit
            known |= texts
            if texts & {*names}:
                chosen.append(j)
                heads.append(("" if group == last else group, second))
                last = group
        places = {old: new for new, old in enumerate(chosen)}
        rows = [[row[j] for j in chosen] for row in table.rows]
        ranks = {(i, places[j]): rank for (i, j), rank in table.ranks.items() if j in places}
        ties = {(i, places[j]) for i, j in table.ties if j in places}
        shown = replace(table, heads=heads, rows=rows, ranks=ranks, ties=ties)
        if len(chosen) > table.labels and not any(_repeats(shown, other) for other in kept):
            kept.append(shown)
    for name in names:
        check_choice("--columns", name, sorted(known))
    return kept


def _repeats(table: Table, other: Table) -> bool:
    """Return True if both show the same of one scene, as means do without and with costs."""
    same = table.heads == other.heads and table.rows == other.rows
    return same and table.title.startswith(other.title)


def tables_text(
    made: Sequence[Table], notes: Iterable[str], style: str, *, width: int | None = None
) -> str:
    """Format tables, and below them the legend of their ranks, if there are any, and the notes.

    Args:
        made: The tables.
        notes: One line each.
        style: ``table``, ``markdown`` or ``latex``.
        width: Characters of the terminal that ``table`` goes to; None for no limit.
    """
    legend = [tables.LEGENDS[style]] if any(table.ranks for table in made) else []
    if style == "markdown":
        texts = [tables.markdown(table, special=r"\`*<>|_") for table in made]
        marks = "".join(f"- {line}\n" for line in legend)  # as they look in the table
        return "\n".join([*texts, marks + tables.markdown_list(notes)])
    notes = [*legend, *notes]
    if style == "latex":
        texts, bullet = [tables.latex(table, cmidrules=True) for table in made], "% "
    else:
        texts, bullet = [tables.boxed_text(table, width=width) for table in made], ""
    return "\n".join([*texts, "".join(f"{bullet}{printable(note)}\n" for note in notes)])


def json_entry(entry: dict[str, Any]) -> dict[str, Any]:
    """Write numbers that JSON lacks as ``Infinity`` and ``NaN``, and unknown ones as null."""
    entry["sd"] = None if entry["n"] == 1 else entry["sd"]
    for key, value in entry.items():
        if isinstance(value, float) and not math.isfinite(value):
            names = {math.inf: "Infinity", -math.inf: "-Infinity"}
            entry[key] = names.get(value, "NaN" if key in ("mean", "sd") else None)
    return entry


def readable_tables(
    entries: DataFrame,
    records: Sequence[RunRecord],
    metrics: Sequence[str] = (),
    *,
    periods: bool = False,
) -> list[Table]:
    """Make an overview, and per scene a table of each metric, two for runs in stages, one of costs.

    Args:
        entries: From `summarise` for the records, and from `published_entries`.
        records: The runs.
        metrics: Names of those wanted; none for all.
        periods: Show every period, however many there are.
    """
    names = metric_names(records, metrics)
    made: list[Table] = []
    shown = [
        name
        for name in all_metrics()
        if (entries.quantity == name).any() and name in (metrics or PAPER_METRICS)
    ]
    if shown and (entries.scene.nunique() > 1 or len(shown) > 1):
        made += _overviews(entries, shown, size=not metrics)
    for scene, part in entries[entries.source == MEASURED].groupby("scene", sort=False):
        runs = [run for run in records if run.scene == scene]
        for name in names:
            made += _quality_tables(part, name, runs, every=periods)
        staged = [run for run in runs if run.stages]
        for name in names if staged else ():
            made += _stage_tables(part, name, staged, every=periods)
        # The cost of images that other programs made is unknown.
        if not metrics and (part.column == "").any():
            made.append(_cost_table(part, str(scene), [name for name in shown if name in names]))
            made += _sharing_tables(part, str(scene))
    return made


class _Column(NamedTuple):
    """A column of a table; a dash stands for labels without an entry."""

    head: Head
    entries: DataFrame
    """At most one for each label."""
    field: str = "text"
    """Field of the entries that cells show; means are marked."""


def _table(title: str, labels: Sequence[str], columns: Sequence[_Column], **options: Any) -> Table:
    """Put columns side by side, with a row for each label."""
    places = {label: i for i, label in enumerate(labels)}
    rows = [[label, *["-"] * len(columns)] for label in labels]
    ranks, ties = {}, set()
    for j, (_, entries, field) in enumerate(columns, 1):
        shown = entries[["label", field, "rank", "tied"]]
        for label, text, rank, tied in shown.itertuples(index=False):
            rows[places[label]][j] = str(text)
            if field in ("text", "number") and rank:
                ranks[places[label], j] = rank
            if field in ("text", "number") and tied:
                ties.add((places[label], j))
    heads = ["method", *(column.head for column in columns)]
    return Table(heads, rows, title=title, ranks=ranks, ties=ties, **options)


def _overviews(entries: DataFrame, names: Sequence[str], *, size: bool) -> Iterable[Table]:
    """Make tables of macro means, methods by scenes, as papers print them, with their mean."""
    labels = entries.label.unique()
    measured = entries[entries.source == MEASURED].label.nunique()
    breaks = {measured - 1} if measured < len(labels) else ()
    parts = [(str(scene), part) for scene, part in entries.groupby("scene", sort=False)]
    title = f"{parts[0][0]}: macro means"
    if several := len(parts) > 1:
        if several_scenes(scene for scene, _ in parts):
            parts.append((ALL_SCENES, over_scenes(entries, ALL_SCENES)))
        title = "all scenes: macro means"
        if len(names) == 1:
            title = f"all scenes: {metric_info(names[0]).title} ({names[0]}), macro"
    columns = []
    for scene, part in parts:
        macro = part[part.column == "macro"]
        for i, name in enumerate(names):
            head = metric_info(name).title if len(names) > 1 else ""
            first = "" if i else scene
            found = macro[macro.quantity == name]
            columns.append(_Column((first, head) if several else head, found, "number"))
    last, part = parts[-1]
    if size and (last == ALL_SCENES or not several):  # else of one test of several
        columns.append(_Column(COST_TITLES[SIZE], part[part.quantity == SIZE], "number"))
    step = MAX_SCENES * len(names)
    starts = range(0, len(parts) * len(names), step)
    for start in starts:
        end = None if start == starts[-1] else start + step
        yield _table(title, labels, columns[start:end], breaks=breaks)


def _quality_tables(
    part: DataFrame, metric: str, runs: Sequence[RunRecord], *, every: bool
) -> list[Table]:
    """Make tables of one metric on one scene: methods by periods and aggregates.

    Many periods are in tables of their own, if ``every`` asks for them.
    """
    info, labels = metric_info(metric), part.label.unique()
    arrow = "higher" if info.higher_is_better else "lower"
    title = f"{runs[0].scene}: {info.title} ({metric}), {arrow} is better"
    found = part[part.quantity == metric]
    by_column = dict(list(found.groupby("column")))
    none = found[:0]
    ids = sorted({i for run in runs for i in run.periods}, key=int)
    single = [
        _Column(period_title(i, runs[0].period_labels), by_column.get(f"period {i}", none))
        for i in ids
    ]
    few = len(ids) <= MAX_PERIODS
    over = [
        _Column(name, by_column.get(name, none))
        for name, _, _, for_many in AGGREGATES
        if not (few and for_many)
    ]
    over[1:1] = _uncertainty(by_column.get("macro", none))
    count = _Column("n", part.drop_duplicates("label"), "runs")
    made = [_table(title, labels, [*(single if few else ()), *over, count])]
    for start in range(0, len(ids), MAX_PERIODS) if every and not few else ():
        chosen = slice(start, start + MAX_PERIODS)
        name = f"{title}; periods {ids[chosen][0]} to {ids[chosen][-1]}"
        made.append(_table(name, labels, single[chosen]))
    return made


def _uncertainty(macro: DataFrame) -> Iterable[_Column]:
    """Make columns of the intervals of macro means and of differences to the best, if known."""
    for head, prefix in (
        (("interval", "over views"), ""),
        (("difference", "to the best"), "difference_"),
    ):
        known = macro[macro[f"{prefix}low"].notna()]
        texts = [interval_text(entry, prefix) for entry in known.to_dict("records")]
        if texts:
            yield _Column(head, known.assign(uncertainty=texts), "uncertainty")


def interval_text(entry: Mapping[Any, Any], prefix: str = "") -> str:
    """Format the interval of a mean, or with ``difference_`` a difference and its interval."""
    low, high = (in_unit(entry["quantity"], entry[prefix + end]) for end in ("low", "high"))
    text = "" if math.isnan(entry[f"{prefix}low"]) else f"[{low}, {high}]"
    difference = in_unit(entry["quantity"], entry["difference"]) if prefix else ""
    return f"{difference} {text}".strip().replace("-", "\N{MINUS SIGN}")


def period_name(period: int | str, labels: dict[str, str]) -> str:
    """Name a period by its label, or by its number where it has none."""
    label = labels.get(str(period), str(period))
    return f"period {label}" if label == str(period) else label


def period_title(period: str, labels: dict[str, str]) -> str:
    """Head the column of a period by its number, and its label if it has one."""
    name = period_name(period, labels)
    return name if name == f"period {period}" else f"{period}: {name}"


def _stage_tables(
    part: DataFrame, metric: str, runs: Sequence[RunRecord], *, every: bool
) -> list[Table]:
    """Make tables of one metric of runs in stages: each period after each stage, and at the end.

    The first is left out where there are many periods, unless ``every`` asks for it.
    """
    found = part[part.quantity == metric]
    texts = found.set_index(["label", "column"]).text
    labels = found.label[found.column.str.startswith(f"{period_part(0)}: ")].unique()
    ids = list(runs[0].period_labels)
    titles = [period_title(i, runs[0].period_labels) for i in ids]
    stages = [UNTRAINED, *(period_part(int(i)) for i in ids)]
    rows = [
        ["" if number else label, after]
        + [texts.get((label, f"{stage}: period {i}"), "-") for i in ids]
        for label in labels
        for number, (stage, after) in enumerate(zip(stages, ["no training", *titles], strict=True))
    ]
    heads = ["method", "after", *titles]
    title = f"{runs[0].scene}: {metric_info(metric).title} ({metric}) after"
    breaks = range(len(stages) - 1, len(rows) - 1, len(stages))
    matrix = Table(heads, rows, labels=2, title=f"{title} each stage", breaks=breaks)
    columns = ("macro", *TRANSFERS)
    rows = [[label, *(texts.get((label, column), "-") for column in columns)] for label in labels]
    heads = ["method", *(column.replace("_", " ") for column in columns)]
    left = Table(heads, rows, title=f"{title} the last stage")
    return [matrix, left] if every or len(ids) <= MAX_PERIODS else [left]


def _cost_table(part: DataFrame, scene: str, metrics: Sequence[str]) -> Table:
    """Make the table of macro means and costs of the runs on one scene."""
    costs, macro = part[part.column == ""], part[part.column == "macro"]
    columns = [_Column(metric_info(m).title, macro[macro.quantity == m]) for m in metrics]
    for cost in COSTS:
        found = costs[costs.quantity == cost.name]
        if cost.name in TIMES and found.device.nunique() > 1:
            heads = [cost.title, *[""] * (found.device.nunique() - 1)]
            by_device = zip(heads, found.groupby("device", sort=False), strict=True)
            columns += [_Column((head, device), part) for head, (device, part) in by_device]
        elif len(found):
            columns.append(_Column(cost.title, found))
    columns.append(_Column("seeds", part.drop_duplicates("label"), "seeds"))
    title = f"{scene}: macro means and cost" if metrics else f"{scene}: cost"
    return _table(title, part.label.unique(), columns)


def _sharing_tables(part: DataFrame, scene: str) -> list[Table]:
    """Make the table of what the periods share in each method that can tell, if any can."""
    by_quantity = [(cost.title, part[part.quantity == cost.name]) for cost in SHARING]
    labels = by_quantity[0][1].label.unique()
    columns = [_Column(title, found) for title, found in by_quantity]
    return [_table(f"{scene}: what periods share", labels, columns)] if len(labels) else []


def footnotes(
    entries: DataFrame,
    records: Sequence[RunRecord],
    failures: Sequence[Failure],
    wanted: Sequence[str] = (),
    *,
    macro_only: bool = False,
) -> list[str]:
    """List the notes below tables: aggregates, spread, device, code, absent values and reasons.

    With ``macro_only``, the tables have neither other aggregates, nor intervals of the means, nor
    what periods share.
    """
    many = not macro_only and any(len(run.periods) > MAX_PERIODS for run in records)
    aggregates = AGGREGATES[:1] if macro_only else AGGREGATES
    known = [f"{a.name}: {a.meaning}" for a in aggregates if many or not a.for_many_periods]
    notes = ["; ".join(known) + ("; --periods shows every period" if many else "")]
    if (entries.n > 1).any():
        notes.append("±: sample standard deviation over n seeds")
    if entries.low.notna().any() and not macro_only:
        notes.append(
            "[ ]: 95 % interval of macro over test views, by a bootstrap of blocks of neighbours "
            "in each period; seeds are averaged before"
        )
    if entries.difference_low.notna().any():
        notes.append(
            "[ ] of a difference: over test views and seeds, whose spread is pooled over methods"
            if entries.by_seeds.notna().any()
            else "[ ] of a difference: over test views; with one seed, the spread of seeds is "
            "unknown and not in it"
        )
    if entries.tied.any():
        tied = entries[entries.tied]
        counts = [
            sum(column == f"period {period}" for _, period, _ in views)
            for column, views in zip(tied.column, tied.views, strict=True)
        ]
        fewest = min(filter(None, counts), default=FEW_VIEWS)
        notes.append(
            "†: at 95 %, not separated from the best of its column, which was chosen among all"
            + (
                f"; periods with {counted(fewest, 'test view')} separate little"
                * (fewest < FEW_VIEWS)
            )
        )
    for name, title in (("device", "device"), ("commit", "code")):
        values = dict.fromkeys(str(getattr(run, name)) for run in records)
        if values:
            notes.append(f"{title}: {'; '.join(values)}")
    mixed = entries[entries.devices > 1].label.unique()
    if len(mixed):
        notes.append(
            f"seeds of several devices are averaged, but for their times: {'; '.join(mixed)}"
        )
    if any(len({effort_of(r) for r in records if r.scene == s}) > 1 for s in {*entries.scene}):
        efforts = _grouped((effort_of(run), f"{run.title} ({run.preset})") for run in records)
        said = "; ".join(f"{effort}: {names}" for effort, names in efforts)
        notes.append(f"efforts differ, and a difference may be theirs: {said}")
    units_of = [(r.primitive, r.title) for r in records if r.primitives is not None and not wanted]
    shared = entries.quantity.isin([cost.name for cost in SHARING]).any()
    if shared and not wanted and not macro_only:
        notes.append(
            "invariant: primitives with one block of features for all periods; blocks each: mean "
            "over primitives; numbers: those stored for one period alone, mean over periods"
        )
    if units := "; ".join(f"{unit} of {titles}" for unit, titles in _grouped(units_of)):
        notes.append(f"primitives: {units}")
    absent = _grouped((why, name) for run in records for name, why in _absent(run, wanted))
    notes += [f"absent: {names}: {reason}" for reason, names in absent]
    notes += dict.fromkeys(notice for run in records for notice in run.notices)
    failed = [((f"{f.scene}, {f.method} ({kind_of(f)})", f.reason), f.seed) for f in failures]
    notes += [f"failed: {n}, seed {seeds}: {reason}" for (n, reason), seeds in _grouped(failed)]
    return notes


def _absent(run: RunRecord, wanted: Sequence[str]) -> Iterator[tuple[str, str]]:
    """Yield metrics and costs that a run lacks, each with the reason; metrics alone if wanted."""
    there = {*run.skipped, *run.aggregates.get("macro", {})}
    for name, reason in run.skipped.items():
        if not wanted or name in wanted:
            yield name, reason
    for cost, reason in run.absent.items() if not wanted else ():
        if cost in COST_TITLES:
            yield COST_TITLES[cost], reason
    for name in wanted:
        if name not in there:
            reason = f"no value: chronoscene score RUNS --metric {name} computes it where it can be"
            yield name, reason


def _grouped(pairs: Iterable[tuple[Any, Any]]) -> Iterable[tuple[Any, str]]:
    """Return each key once, with its different values joined by commas."""
    values: dict[Any, dict[str, None]] = {}
    for key, value in pairs:
        values.setdefault(key, {})[str(value)] = None
    return [(key, ", ".join(of_key)) for key, of_key in values.items()]


def published_notes(table: PublishedTable, records: Sequence[RunRecord]) -> list[str]:
    """List the notes on published rows, and the scenes that have none."""
    known = {row.scene.casefold() for row in table.rows}
    strange = dict.fromkeys(
        run.scene
        for run in records
        if not (run.protocol or scene_of(run.scene).casefold() in known)
    )
    notes = [
        f"published: {table.title}; {table.hardware}. Scenes of equal names may have other photos, "
        f"test views and sizes. {' '.join(table.notes)}"
    ]
    if strange:
        scenes = ", ".join(dict.fromkeys(row.scene for row in table.rows))
        notes.append(f"nothing is published of {', '.join(strange)}; the scenes are {scenes}")
    return notes
