"""What rules say about a scene, and the outcome of a validation as data."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

Severity = Literal["error", "warning", "info"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
"""From worst to harmless.

error: the scene cannot be read, or results on it would be wrong. warning: the scene can be used,
but probably not as its author intended, or another program fails on it. info: worth knowing,
nothing needs repair.
"""

NOTHING = "nothing to do"
"""Remedy of findings that are for information only."""


@dataclass(frozen=True, slots=True)
class Hit:
    """One problem as a rule yields it; `chronoscene.validation.run` turns it into a `Finding`."""

    place: str
    """File, file and line, or file and record; relative to the scene folder."""
    expected: str
    found: str
    remedy: str | None = None
    """Only where the remedy of the rule is not specific enough."""
    count: int = 1
    """Number of points, images, ... concerned."""
    also: tuple[str, ...] = ()
    """Names of further images to look at beside that of the place."""


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


@dataclass(frozen=True, slots=True)
class PeriodSummary:
    """Counts of one period."""

    id: int
    images: int
    train: int | None
    """None if the split is unknown."""
    test: int | None
    reprojection_px: float | None = None
    """Median over its images of their median reprojection errors, if a rule needed it."""


@dataclass(frozen=True, slots=True)
class Summary:
    """What is in a scene; None for what cannot be read."""

    images: int | None
    cameras: int | None
    points: int | None
    observations: int | None
    image_files: int
    """Files in ``images/``, registered or not."""
    periods: tuple[PeriodSummary, ...]


@dataclass(frozen=True, slots=True)
class Skipped:
    """A rule that could not be run."""

    code: str
    reason: str


@dataclass(frozen=True, slots=True)
class SceneReport:
    """Everything that was found in one scene."""

    name: str
    path: Path
    summary: Summary
    findings: tuple[Finding, ...]
    """Errors first, then by code, then in the order of the rule."""
    skipped: tuple[Skipped, ...]

    def count(self, severity: Severity) -> int:
        return sum(f.severity == severity for f in self.findings)


def counts(reports: Iterable[SceneReport]) -> dict[Severity, int]:
    """Number of findings by severity over several scenes."""
    found = tuple(reports)
    return {severity: sum(r.count(severity) for r in found) for severity in SEVERITIES}


def is_valid(reports: Iterable[SceneReport], *, strict: bool) -> bool:
    """Whether the scenes have no error and, with ``strict``, no warning."""
    total = counts(reports)
    return not total["error"] and not (strict and total["warning"])
