"""What tables and figures call a period."""

from __future__ import annotations


def period_name(period: int, label: str, date: str | None) -> str:
    """Its label, and its date where the label lacks the year; the number if there is neither."""
    names = [label] if label != str(period) else []
    if date is not None and date[:4] not in label:
        names.append(date)
    return ", ".join(names) or str(period)


def period_title(period: int, label: str, date: str | None) -> str:
    """Its number, and its name where that is more than the number."""
    name = period_name(period, label, date)
    return name if name == str(period) else f"{period}: {name}"
