"""What rules say about a scene."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Severity = Literal["error", "warning", "info"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
"""From bad to harmless.

error: the scene cannot be read, or results on it would be wrong. warning: it can be used, but
something is probably not as its author meant it, or another program fails on it. info: worth
knowing, nothing to repair.
"""

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
