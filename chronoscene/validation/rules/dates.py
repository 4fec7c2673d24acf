"""CS225 to CS228: dates of capture, in photos and in names, inside of a period and across them."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from datetime import datetime, time, timedelta
from itertools import pairwise

from chronoscene.formats.chronoscene import PERIODS, SPLIT
from chronoscene.io.wording import counted, shown
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.photo_metadata import (
    dates_of,
    median_dates,
    of_other_period,
    stated_dates,
)
from chronoscene.validation.scene_folder import RawScene

FEWEST_DATES = 5
"""Photos with a date from which one can be alone among them."""

ALONE = timedelta(days=183)
"""Visits to a place that are one period may be months apart."""

ALONE_RATIO = 10.0
"""And so many times as far as three quarters of the photos are from the median date."""

ONE_VISIT = timedelta(minutes=5)
"""Photos that follow each other so soon were taken on one visit."""

PURE = 0.9
"""Share of the images whose period must be that of most images beside them."""

FEWEST_BESIDE = 3
"""Images of a folder from which most of them mean something."""

MOST_WITH_YEAR = 0.9
"""Share of the images of a period whose names must have one year in common."""

_BEGIN = re.compile(
    r"(?:p|t|day|date|time|epoch|period|visit)[-_]?\d+(?=[-_.])|(?:19[89]|20[0-4])\d(?:-?\d\d){0,2}(?!\d)",
    re.IGNORECASE,
)


@rule(
    "CS225",
    "exif-date-alone",
    "warning",
    what="The date in a photo is half a year or more from those of its period, and of no other "
    "period.",
    remedy="look at the photo: it may be of a date that has no period; if its camera's clock was "
    "wrong, ignore this rule",
    bad="a photo of 2019 among those of May 2016, in a scene of 2016 and 2023",
    needs=("periods",),
)
def exif_date_alone(scene: RawScene) -> Iterator[Hit]:
    by_period: dict[int, dict[str, datetime]] = {}
    for name, taken in dates_of(scene).items():
        by_period.setdefault((scene.periods or {})[name], {})[name] = taken
    elsewhere = of_other_period(scene)
    for dates in by_period.values():
        if len(dates) < FEWEST_DATES:
            continue
        middle = sorted(dates.values())[len(dates) // 2]
        away = sorted(abs(taken - middle) for taken in dates.values())
        limit = max(ALONE, ALONE_RATIO * away[3 * len(away) // 4])
        for name, taken in dates.items():
            if abs(taken - middle) > limit and name not in elsewhere:
                expected = f"a date about {middle:%Y-%m-%d}"
                yield Hit(f"images/{name}", expected, f"{taken:%Y-%m-%d}")


@rule(
    "CS226",
    "one-visit-in-two-periods",
    "warning",
    what="Photos that were taken within five minutes of each other are in different periods.",
    remedy="put the photos of one visit into one period; if the dates were copied from one photo "
    "to others, ignore this rule",
    bad="every second photo of a flight in period 0, the others in period 1",
    needs=("periods",),
)
def one_visit_in_two_periods(scene: RawScene) -> Iterator[Hit]:
    periods = scene.periods or {}
    misfiled = of_other_period(scene)  # has its own finding
    taken = sorted(
        (moment, name)
        for name, moment in dates_of(scene).items()
        if moment.time() != time() and name not in misfiled  # midnight: no time of day is known
    )
    found: dict[tuple[int, ...], list[tuple[str, str]]] = {}
    for (early, a), (late, b) in pairwise(taken):
        if periods[a] != periods[b] and late - early <= ONE_VISIT:
            found.setdefault(tuple(sorted((periods[a], periods[b]))), []).append((a, b))
    for (one, other), pairs in found.items():
        text = f"{counted(len(pairs), 'time')} within five minutes: {shown(pairs[0])}"
        expected = f"photos of periods {one} and {other} at different times"
        yield Hit(SPLIT, expected, text, count=len(pairs))


@rule(
    "CS227",
    "names-period-order",
    "warning",
    what="The years in the names of the images, or the dates in `sparse/periods.json`, contradict "
    "the order of the periods.",
    remedy="number the periods by date",
    bad="images in `2023/` in period 0, those in `2016/` in period 1",
    needs=("periods",),
)
def names_period_order(scene: RawScene) -> Iterator[Hit]:
    known = median_dates(scene)  # with these, the stated dates have been compared already
    stated = {period: date for period, date in stated_dates(scene).items() if period not in known}
    for earlier, later in pairwise(sorted(stated)):
        # Dates of different precision are compared as far as both go.
        a, b = (
            stated[p][: min(len(stated[earlier]), len(stated[later]))] for p in (earlier, later)
        )
        if a > b:
            expected = f"a date after {stated[earlier]}, that of period {earlier}"
            yield Hit(f"{PERIODS} (period {later})", expected, stated[later])
    years = _years(scene)
    for earlier, later in pairwise(sorted(years)):
        if years[earlier] > years[later]:
            expected = f"names with a year after {years[earlier]}, as in period {earlier}"
            yield Hit(f"period {later}", expected, str(years[later]))


def _years(scene: RawScene) -> dict[int, int]:
    """The year that nearly all names of a period have, by period."""
    names: dict[int, list[str]] = {}
    for name, period in (scene.periods or {}).items():
        names.setdefault(period, []).append(name)
    years = {}
    for period, group in names.items():
        found = Counter(year for name in group for year in {_year(name)} if year is not None)
        year, times = max(found.items(), key=lambda item: item[1], default=(0, 0))
        if times >= MOST_WITH_YEAR * len(group):
            years[period] = year
    return years


def _year(name: str) -> int | None:
    """The first year in a name, also as the beginning of a date without hyphens."""
    found = re.search(
        r"(?<!\d)((?:19[89]|20[0-4])\d)(?:(?!\d)|(?=(?:0\d|1[0-2])[0-3]\d(?!\d)))", name
    )
    return int(found[1]) if found else None


@rule(
    "CS228",
    "names-other-period",
    "warning",
    what="Folders, or dates or numbers of periods at the beginning of names, go with the periods, "
    "but for a few images.",
    remedy="look at the image; correct its period in split.txt",
    bad="`2016/a.jpg` in period 1, all other images of `2016/` in period 0",
    needs=("periods",),
)
def names_other_period(scene: RawScene) -> Iterator[Hit]:
    periods, groups = scene.periods or {}, _groups(scene)
    usual = {
        key: Counter(periods[name] for name in names).most_common(1)[0]
        for key, names in groups.items()
        if len(names) >= FEWEST_BESIDE
    }
    total = sum(len(groups[key]) for key in usual)
    if len({period for period, _ in usual.values()}) < 2:
        return
    if sum(number for _, number in usual.values()) < PURE * total:
        return
    for key, (period, _) in usual.items():
        for name in groups[key]:
            if periods[name] != period:
                expected = f"period {period}, as for the other images with {key!r}"
                yield Hit(f"{SPLIT} ({name})", expected, f"period {periods[name]}")


def _groups(scene: RawScene) -> dict[str, list[str]]:
    """Images by their folder, or by the date or number of a period that their names begin with."""
    groups: dict[str, list[str]] = {}
    for name in scene.periods or {}:
        folder, _, file = name.rpartition("/")
        begin = _BEGIN.match(file)
        key = f"{folder}/" if folder else begin[0] if begin else None
        if key is not None:
            groups.setdefault(key, []).append(name)
    return groups
