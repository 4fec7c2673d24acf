"""Rules, the table that they register in, and the results of a validation as data.

A rule is a small function in `chronoscene.validation.rules` with a decorator for its severity. Its
parameters name the attributes of `RawScene` that it looks at (``scene`` is the scene itself); it is
skipped if one of them is None, or what it is read from, and yields a `Hit` for each problem::

    @rule.warning("CS122", bad="quaternion `2 0 0 0`", remedy="normalise the quaternion")
    def quaternion_not_unit(scene: RawScene, images: RawImages) -> Iterator[Hit]:
        '''A quaternion does not have unit length.'''
        ...

The docstring describes the fault; the name is that of the function, here ``quaternion-not-unit``.
Codes are stable and never reused (`RETIRED`). ``docs/reference/validation-rules.md``
lists all rules.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Literal, TypeVar

from chronoscene.validation.folder.scene_folder import RawScene

Severity = Literal["error", "warning", "info"]

SEVERITIES: tuple[Severity, ...] = ("error", "warning", "info")
"""From worst to harmless.

error: the scene cannot be read, or results on it would be wrong. warning: the scene can be used,
but probably not as its author intended, or another program fails on it. info: worth knowing,
nothing needs repair.
"""

LEAVE_OUT = "chronoscene edit DIR OUT --drop IMAGE"
RENAME = "chronoscene edit DIR OUT --rename OLD=NEW"
TRIANGULATE = "chronoscene triangulate DIR OUT"

NOTHING = "nothing to do"  # Remedy of findings that are for information only


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


Check = Callable[..., Iterable[Hit]]
C = TypeVar("C", bound=Check)

GROUPS = {
    "CS0": "Folder",
    "CS1": "COLMAP model",
    "CS2": "Images",
    "CS3": "split.txt and test.txt",
    "CS4": "Periods",
    "CS5": "Points and tracks",
    "CS6": "Leaks between train, test and periods",
    "CS7": "Released ChronoGS code",
}
"""First digit of a code to what its rules look at."""


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule. All texts are shown to users."""

    code: str
    """``CS`` and three digits; the first digit is the group."""
    name: str
    severity: Severity
    what: str
    """Fault that the rule finds, in one or two sentences: the docstring of ``check``. Markdown."""
    remedy: str
    """Remedy in the imperative, without a full stop."""
    bad: str
    """Short example of a scene that breaks the rule. Markdown."""
    parameters: tuple[str, ...]
    """Attributes of `RawScene` that ``check`` takes, or ``scene``."""
    needs: tuple[str, ...]
    """Attributes that must not be None; else the rule is skipped."""
    last: bool
    """Run after all others, and only if those found no error."""
    check: Check

    def hits(self, scene: RawScene) -> Iterable[Hit]:
        """Run the rule; all that it needs must be there."""
        return self.check(*(scene if p == "scene" else getattr(scene, p) for p in self.parameters))


SOURCES = dict.fromkeys(("names", "headers", "readable", "mask_headers", "centres"), "images")
SOURCES["usable_cameras"] = "cameras"
"""Attributes that are empty, not None, without the part that they are read from."""

RETIRED = (
    *("CS109", "CS113", "CS114", "CS142", "CS214", "CS216", "CS226", "CS244", "CS326"),
    *("CS511", "CS517", "CS519", "CS521", "CS524", "CS707"),
)
"""Codes of rules that are gone; they are never reused."""

RULES: dict[str, Rule] = {}
"""Rules by code. Complete when `chronoscene.validation.rules` has been imported."""


def _register(
    severity: Severity,
    code: str,
    *,
    bad: str,
    remedy: str,
    needs: tuple[str, ...] = (),
    last: bool = False,
    what: str = "",
) -> Callable[[C], C]:
    """Register the decorated function as a rule; see `Rule` for the arguments.

    Args:
        needs: Attributes that must not be None besides those that are parameters of the function.
        what: Replaces the docstring if it needs a constant.
    """
    assert re.fullmatch("CS[0-9]{3}", code) and code[:3] in GROUPS, code
    assert code not in RULES and code not in RETIRED, code

    def register(check: C) -> C:
        name = check.__name__.replace("_", "-")
        assert name not in {r.name for r in RULES.values()}, name
        parameters = tuple(inspect.signature(check).parameters)
        needed = (*(SOURCES.get(p, p) for p in parameters if p != "scene"), *needs)
        text = what or " ".join((check.__doc__ or "").split())
        RULES[code] = Rule(code, name, severity, text, remedy, bad, parameters, needed, last, check)
        return check

    return register


# Decorators of the rules of each severity; see `_register`.
error = partial(_register, "error")
warning = partial(_register, "warning")
info = partial(_register, "info")


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
    label: str | None = None
    """None if it has no other than its id."""

    @property
    def title(self) -> str:
        """Id, and label in parentheses."""
        return f"{self.id}" if self.label is None else f"{self.id} ({self.label})"


@dataclass(frozen=True, slots=True)
class Summary:
    """Counts of the content of a scene; None for parts that cannot be read."""

    images: int | None = None
    cameras: int | None = None
    points: int | None = None
    observations: int | None = None
    image_files: int = 0
    """Files in ``images/``, registered or not."""
    periods: tuple[PeriodSummary, ...] = ()


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

    @property
    def is_valid(self) -> bool:
        """True if there are no errors."""
        return not self.count("error")

    def count(self, severity: Severity) -> int:
        """Return the number of findings of a severity."""
        return sum(f.severity == severity for f in self.findings)


def explain(finding: Finding) -> str:
    """Describe the fault in general: as the rule of this code does, if there is one."""
    return RULES[finding.code].what if finding.code in RULES else finding.expected


def counts(reports: Iterable[SceneReport]) -> dict[Severity, int]:
    """Number of findings by severity over several scenes."""
    found = tuple(reports)
    return {severity: sum(r.count(severity) for r in found) for severity in SEVERITIES}


def is_valid(reports: Iterable[SceneReport], *, strict: bool) -> bool:
    """Return True if the scenes have no error and, with ``strict``, no warning."""
    total = counts(reports)
    return not total["error"] and not (strict and total["warning"])
