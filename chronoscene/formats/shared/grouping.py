"""Periods from dates, times, folders or a table: the values of ``--period-by``.

A value of the option is ``year``, ``month``, ``day`` (dates only), ``gap:X`` (a new period where
two neighbours are more than X apart: days, or the unit of the times), ``count:N`` (N periods, cut
at the N - 1 widest gaps) or ``table:FILE`` (a CSV file with the columns ``file`` and ``period``).
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import date
from itertools import pairwise
from pathlib import Path

from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats.shared.json_values import is_iso_date
from chronoscene.io.documents import filled_lines, read_text
from chronoscene.io.wording import shown
from chronoscene.scene import Period
from chronoscene.scene.splits import NameIndex, composed

Grouped = tuple[dict[str, int], tuple[Period, ...]]
"""Period of each image, and the periods."""

OPTION = "--period-by"

TABLE = "table:"

NAME_PERIODS = (
    "name the periods: --period-by year, month or day (dates of the photos), or --period-by "
    "table:FILE (a CSV file with the columns file and period)"
)
"""Advice on a COLMAP project without periods."""

_CALENDAR = {"year": 4, "month": 7, "day": 10}
"""Characters of an ISO date that images of one period share."""


def absolute_rule(rule: str | None) -> str | None:
    """Make a value of ``--period-by`` independent of the current folder."""
    if rule is None or not rule.startswith(TABLE):
        return rule
    return f"{TABLE}{Path(rule.removeprefix(TABLE)).resolve()}"


def natural_key(text: str) -> tuple[tuple[tuple[int, int | str], ...], str]:
    """Sort key with ``t2`` before ``t10``; texts that differ in leading zeros alone by the text."""
    parts = re.findall(r"[0-9]{1,18}|[^0-9]+", text)
    numbers = tuple((0, int(part)) if part[0] in "0123456789" else (1, part) for part in parts)
    return numbers, text


def group_dates(dates: Mapping[str, date], by: str) -> Grouped:
    """Group images by the dates on which they were taken.

    Raises:
        ConfigError: If ``by`` is not one of the rules, or asks for more periods than there are
            dates.
    """
    if by in _CALENDAR:
        length = _CALENDAR[by]
        keys = {name: when.isoformat()[:length] for name, when in dates.items()}
        order = sorted(set(keys.values()))
        periods = tuple(Period(i, key, key) for i, key in enumerate(order))
        return {name: order.index(key) for name, key in keys.items()}, periods
    days = {name: float(when.toordinal()) for name, when in dates.items()}

    def describe(first: float, last: float) -> tuple[str, str | None]:
        a, b = (date.fromordinal(int(x)).isoformat() for x in (first, last))
        shared = next((a[:n] for n in (10, 7, 4) if a[:n] == b[:n]), None)
        return (a if a == b else f"{a} to {b}"), shared

    return _group_numbers(days, by, describe, rules=(*_CALENDAR, "gap:DAYS", "count:N"))


def group_times(times: Mapping[str, float], by: str) -> Grouped:
    """Group images by times of an unknown unit; labels are times, all different.

    Raises:
        ConfigError: As `group_dates`.
    """

    distinct = set(times.values())
    digits = next(d for d in (6, 12, 17) if len({f"{t:.{d}g}" for t in distinct}) == len(distinct))

    def describe(first: float, last: float) -> tuple[str, str | None]:
        a, b = (f"{time:.{digits}g}" for time in (first, last))
        return (a if first == last else f"{a} to {b}"), None

    return _group_numbers(times, by, describe, rules=("gap:X", "count:N"))


def group_labels(labels: Mapping[str, str], order: Sequence[str]) -> Grouped:
    """Make a period of each label, in the given order; a label that is a date is the date too."""
    index = {label: i for i, label in enumerate(order)}
    periods = tuple(Period(i, label, label_date(label)) for i, label in enumerate(order))
    return {name: index[label] for name, label in labels.items()}, periods


def label_date(label: str) -> str | None:
    """The label itself where it is an ISO date: year-month-day, year-month or a year."""
    return label if label[:2] in ("19", "20") and is_iso_date(label) else None


def read_table(
    path: Path, images: Sequence[str] = ("file",), label: str = "period"
) -> list[tuple[str, str, str]]:
    """Read place for messages, image and label of each row of a CSV file.

    Args:
        path: Of the file.
        images: Names that the column of the images may have.
        label: Name of the other column.

    Raises:
        SceneError: If it is not a CSV file, is empty, or lacks a column.
    """
    lines = filled_lines(read_text(path))
    try:
        reader = csv.DictReader((line for _, line in lines), skipinitialspace=True)
        rows = [(f"{path}:{lines[reader.line_num - 1][0]}", row) for row in reader]
    except csv.Error as error:
        raise _table_error(path, "a CSV file", str(error)) from error
    columns = rows[0][1] if rows else {}
    column = next((name for name in images if name in columns), None)
    if column is None or label not in columns:
        found = lines[0][1] if lines else "an empty file"
        expected = f"the columns {images[0]} and {label}, and at least one row"
        if re.search(r"[;\t]", found):
            raise _table_error(path, expected, found[:80], "separate the columns by commas")
        raise _table_error(path, expected, found[:80])
    return [(at, (row[column] or "").strip(), (row[label] or "").strip()) for at, row in rows]


def group_by_table(names: Sequence[str], path: Path) -> Grouped:
    """Read periods from a CSV file; labels are sorted naturally, so numbers and dates are in order.

    Raises:
        SceneError: If the file is damaged, or an image is missing or ambiguous in it.
    """
    whole = {composed(name): name for name in names}
    index, respelt = NameIndex(names), NameIndex(whole)
    labels: dict[str, str] = {}
    for place, name, label in read_table(path):
        found = index.find(name) or [whole[key] for key in respelt.find(composed(name))]
        if len(found) > 1:
            several = f"{name!r}, which matches {shown(found)}"
            todo = "write the full names below images/"
            raise _table_error(place, "a name that matches one image", several, todo)
        if found and label and (first := labels.setdefault(found[0], label)) != label:
            both = f"{first!r} and {label!r}"
            raise _table_error(place, f"one period of {name!r}", both, "keep one of the two")
    if lost := [name for name in names if name not in labels]:
        missing = f"none of {len(lost)} of {len(names)}: {shown(lost)}"
        raise _table_error(path, "a period of every image", missing, "add rows for them")
    return group_labels(labels, sorted(set(labels.values()), key=natural_key))


def _table_error(
    place: object, expected: str, found: str, todo: str = "correct the table"
) -> SceneError:
    return SceneError(place, expected=expected, found=found, todo=todo)


def rule_error(by: str, rules: Iterable[str]) -> ConfigError:
    """An unknown value of the option."""
    return ConfigError(
        OPTION, expected=f"one of {', '.join(rules)}", found=repr(by), todo="choose one of them"
    )


def _group_numbers(
    values: Mapping[str, float],
    by: str,
    describe: Callable[[float, float], tuple[str, str | None]],
    *,
    rules: tuple[str, ...],
) -> Grouped:
    """Cut the sorted distinct values by the rule, and number the pieces."""
    distinct = sorted(set(values.values()))
    pieces = _pieces(distinct, by, rules)
    index = {value: i for i, piece in enumerate(pieces) for value in piece}
    periods = tuple(Period(i, *describe(piece[0], piece[-1])) for i, piece in enumerate(pieces))
    return {name: index[value] for name, value in values.items()}, periods


def _pieces(distinct: list[float], by: str, rules: tuple[str, ...]) -> list[list[float]]:
    gaps = [b - a for a, b in pairwise(distinct)]
    kind, _, number = by.partition(":")
    if kind == "gap" and _positive(number):
        cuts = [i for i, gap in enumerate(gaps) if gap > float(number)]
    elif kind == "count" and re.fullmatch("[1-9][0-9]{0,5}", number):
        if int(number) > len(distinct):
            raise ConfigError(
                f"{OPTION} {by}",
                expected=f"at most {len(distinct)} periods",
                found=number,
                todo="ask for no more periods than there are different dates or times",
            )
        widest = sorted(range(len(gaps)), key=lambda i: (-gaps[i], i))
        cuts = sorted(widest[: int(number) - 1])
    else:
        raise rule_error(by, rules)
    ends = [0, *(i + 1 for i in cuts), len(distinct)]
    return [distinct[a:b] for a, b in pairwise(ends)]


def _positive(text: str) -> bool:
    try:
        return math.isfinite(float(text)) and float(text) > 0
    except ValueError:
        return False
