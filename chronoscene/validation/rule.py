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
from difflib import get_close_matches

from chronoscene.errors import ConfigError
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


def all_rules() -> tuple[Rule, ...]:
    """Every rule, sorted by code."""
    import chronoscene.validation.rules  # noqa: F401  (registers them; would be circular above)

    return tuple(RULES[code] for code in sorted(RULES))


def choose_rules(
    select: Iterable[str] = (), ignore: Iterable[str] = (), *, place: str = "--select"
) -> tuple[Rule, ...]:
    """Rules to run.

    Args:
        select: Codes, beginnings of codes (``CS2``) or names; nothing selects all.
        ignore: The same, taken away afterwards.
        place: Option that ``select`` comes from, for errors.

    Raises:
        ConfigError: If one fits no rule.
    """
    rules = all_rules()
    wanted = [_matching(place, text, rules) for text in select]
    unwanted = [_matching("--ignore", text, rules) for text in ignore]
    codes = set().union(*wanted) if wanted else {r.code for r in rules}
    codes -= set().union(*unwanted)
    return tuple(r for r in rules if r.code in codes)


def _matching(place: str, text: str, rules: tuple[Rule, ...]) -> set[str]:
    """Codes of the rules that a user means."""
    key = text.strip()
    codes = {r.code for r in rules if r.name == key.lower()}
    if re.fullmatch("CS[0-9]{0,3}", key.upper()):
        codes |= {r.code for r in rules if r.code.startswith(key.upper())}
    if codes:
        return codes
    known = [r.code for r in rules] + [r.name for r in rules]
    close = get_close_matches(key, known, n=1)
    raise ConfigError(
        place,
        expected=f"codes of rules, beginnings of codes ({', '.join(GROUPS)}) or names",
        found=repr(text),
        todo=f"did you mean {close[0]}?" if close else "DATASET.md lists the rules",
    )
