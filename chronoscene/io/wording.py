"""Names and numbers in sentences."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

_LINES_AND_COLOURS = re.compile(r"(\n|\x1b\[(?:0|1|3\d|9\d)m)")
MAX_NAME_LENGTH = 120  # Characters of a name from a file that a message repeats


def printable(text: str) -> str:
    """Escape characters that could disturb a terminal or an encoding."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def printable_lines(text: str) -> str:
    """Escape as `printable` does, but keep the ends of lines and colours as click sets them."""
    parts = _LINES_AND_COLOURS.split(text)
    return "".join(part if i % 2 else printable(part) for i, part in enumerate(parts))


def quote(text: str) -> str:
    """Quote a name, shortened if it is very long."""
    return repr(text if len(text) <= MAX_NAME_LENGTH else text[:MAX_NAME_LENGTH] + "...")


def shown(items: Iterable[str], limit: int = 3) -> str:
    """List the first few of some names, and the number of the others."""
    names: Sequence[str] = tuple(items)
    rest = len(names) - limit
    return ", ".join(map(quote, names[:limit])) + (f" and {rest} more" if rest > 0 else "")


def joined(words: Iterable[str]) -> str:
    """Join words: ``A``, ``A and B``, ``A, B and C``."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last


def counted(number: int, noun: str) -> str:
    """Count a noun: ``1 image``, ``2 images``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")


def in_words(size: int) -> str:
    """Format a number of bytes: ``1.2 GB``, ``340 kB``."""
    for unit, bytes_each in (("GB", 10**9), ("MB", 10**6)):
        if size >= bytes_each:
            return f"{size / bytes_each:,.1f} {unit}"
    return f"{size / 1000:.1f} kB"


def format_time(seconds: float) -> str:
    """Format seconds as ``m:ss`` or ``h:mm:ss``."""
    minutes, rest = divmod(round(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02}:{rest:02}" if hours else f"{minutes}:{rest:02}"
