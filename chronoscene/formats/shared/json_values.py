"""Labels and dates of periods, and the world frame, as JSON."""

from __future__ import annotations

import re
from collections.abc import Iterable
from datetime import date
from pathlib import Path
from typing import Any

from chronoscene.checks import check_choice
from chronoscene.errors import SceneError
from chronoscene.io.documents import is_number, json_error
from chronoscene.scene import Period, WorldFrame


def parse_periods(place: Path, items: list[Any], count: int) -> tuple[Period, ...]:
    """Parse the content of ``periods.json``.

    Raises:
        SceneError: If they are damaged, or their ids are not 0 to ``count - 1``.
    """
    ids = [item.get("id") if isinstance(item, dict) else None for item in items]
    if ids != [*range(count)]:
        found = ", ".join(str(i)[:40] for i in ids[:8]) + (", ..." if len(ids) > 8 else "")
        expected = f"objects with the ids 0..{count - 1} in order, one for each period"
        raise json_error(place, expected, found or "none")
    return tuple(_parse_period(place, item) for item in items)


def _parse_period(place: Path, item: dict[str, Any]) -> Period:
    _check_keys(place, item, {"id", "label", "date"})
    label, when = item.get("label", str(item["id"])), item.get("date")
    if not isinstance(label, str) or not label.strip():
        raise json_error(place, "a label that is text", repr(label))
    if when is not None and not (isinstance(when, str) and is_iso_date(when)):
        raise json_error(place, "a date YYYY, YYYY-MM or YYYY-MM-DD, or null", repr(when))
    return Period(item["id"], label, when)


def period_items(periods: Iterable[Period]) -> list[dict[str, Any]]:
    """Periods as they stand in ``periods.json``; `parse_periods` reads them."""
    return [{"id": p.id, "label": p.label, "date": p.date} for p in periods]


def is_iso_date(text: str) -> bool:
    """Return True for a calendar date: year, year-month or year-month-day."""
    if not re.fullmatch(r"[0-9]{4}(-[0-9]{2}){0,2}", text):
        return False
    try:
        date.fromisoformat(text + "-01" * (2 - text.count("-")))
    except ValueError:
        return False
    return True


def parse_world(place: Path, data: dict[str, Any]) -> WorldFrame:
    """Parse the content of ``world.json``.

    Raises:
        SceneError: If it is damaged.
    """
    _check_keys(place, data, {"unit", "crs", "offset"})
    unit, crs, offset = data.get("unit", "unknown"), data.get("crs"), data.get("offset", [0, 0, 0])
    check_choice(f"{place}: unit", str(unit), ("metre", "unknown"), error=SceneError)
    if crs is not None and not isinstance(crs, str):
        raise json_error(place, "a crs such as EPSG:32650, or null", repr(crs))
    if not (isinstance(offset, list) and len(offset) == 3 and all(map(is_number, offset))):
        raise json_error(place, "an offset of three numbers", repr(offset))
    return WorldFrame(unit, crs, (float(offset[0]), float(offset[1]), float(offset[2])))


def world_item(world: WorldFrame) -> dict[str, Any]:
    """A world frame as it stands in ``world.json``; `parse_world` reads it."""
    return {"unit": world.unit, "crs": world.crs, "offset": list(world.offset)}


def _check_keys(place: Path, item: dict[str, Any], known: set[str]) -> None:
    if unknown := sorted(item.keys() - known):
        raise json_error(place, f"only the keys {', '.join(sorted(known))}", ", ".join(unknown))
