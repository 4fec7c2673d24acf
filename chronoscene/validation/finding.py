"""What rules say about a scene."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
"""From bad to harmless.

error: the scene cannot be read, or results on it would be wrong. warning: it can be used, but
something is probably not as its author meant it, or another program fails on it. info: worth
knowing, nothing to repair.
"""

LONGEST = 120
"""Characters of a name from a file that a message repeats."""


NOTHING = "nothing to do"
"""Remedy of what is only worth knowing."""


@dataclass(frozen=True, slots=True)
class Hit:
    """One problem as a rule yields it; `chronoscene.validation.run` makes a `Finding` of it."""

    place: str
    """File, file and line, or file and record; relative to the scene folder."""
    expected: str
    found: str
    remedy: str | None = None
    """Only where the remedy of the rule is not specific enough."""
    count: int = 1
    """Number of things (points, images) that this is about."""
    also: tuple[str, ...] = ()
    """Names of other images that this is about, to look at beside that of the place."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One problem of a scene. All texts are printable."""

    code: str
    name: str
    severity: Severity
    place: str
    expected: str
    found: str
    remedy: str
    count: int
    also: tuple[str, ...] = ()
    """See `Hit.also`."""

    def __str__(self) -> str:
        return f"{self.place}: expected {self.expected}, found {self.found}"


def printable(text: str) -> str:
    """Text with everything that could disturb a terminal or an encoder as escapes."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def quote(text: str) -> str:
    """A name in quotes, cut where it is absurdly long."""
    return repr(text if len(text) <= LONGEST else text[:LONGEST] + "...")


def shown(items: Iterable[str], limit: int = 3) -> str:
    """The first few of some names, and how many more there are."""
    names: Sequence[str] = tuple(items)
    rest = len(names) - limit
    return ", ".join(map(quote, names[:limit])) + (f" and {rest} more" if rest > 0 else "")


def counted(number: int, noun: str) -> str:
    """``1 image``, ``2 images``."""
    return f"{number} {noun}" + ("" if number == 1 else "s")
