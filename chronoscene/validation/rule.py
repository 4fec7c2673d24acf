"""What a rule is, and the table of all rules.

A rule is one small function in `chronoscene.validation.rules` with the decorator `rule`. It gets
the scene as it lies on disk and yields a `Hit` for each problem::

    @rule(
        "CS201",
        "image-missing",
        "error",
        what="A registered image has no file.",
        remedy="copy the image into images/, or remove it from the model",
        bad="`images.bin` names `a.jpg`, `images/a.jpg` does not exist",
        needs=("images",),
    )
    def image_missing(scene: RawScene) -> Iterator[Hit]:
        ...

Codes are stable: a code is never given to another rule. DATASET.md has the table
(`python -m chronoscene.validation.report.rule_list` prints it).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from chronoscene.validation.finding import SEVERITIES, Hit, Severity
from chronoscene.validation.scene_folder import RawScene

Check = Callable[[RawScene], Iterable[Hit]]


@dataclass(frozen=True, slots=True)
class Rule:
    """One rule. Everything except ``check`` is documentation and is shown to users."""

    code: str
    """``CS`` and three digits; the first digit is the group."""
    name: str
    severity: Severity
    what: str
    """What is wrong, in one sentence."""
    remedy: str
    """What to do, in the imperative, without a full stop."""
    bad: str
    """Short example of a scene that breaks the rule. Markdown."""
    needs: tuple[str, ...]
    """Attributes of `RawScene` that must not be None; else the rule is not run."""
    last: bool
    """Run after all others, and only if those found no error."""
    check: Check


RULES: dict[str, Rule] = {}
"""All rules by code. Filled when `chronoscene.validation.rules` is imported."""

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


def rule(
    code: str,
    name: str,
    severity: Severity,
    *,
    what: str,
    remedy: str,
    bad: str,
    needs: tuple[str, ...] = (),
    last: bool = False,
) -> Callable[[Check], Check]:
    """Register the decorated function as a rule; see `Rule` for the arguments."""
    assert re.fullmatch("CS[0-9]{3}", code) and code[:3] in GROUPS, code
    assert severity in SEVERITIES, severity
    assert code not in RULES and name not in {r.name for r in RULES.values()}, f"{code} {name}"

    def register(check: Check) -> Check:
        RULES[code] = Rule(code, name, severity, what, remedy, bad, needs, last, check)
        return check

    return register
