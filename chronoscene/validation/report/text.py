"""Report for people: grouped by scene and rule, similar findings folded into one line."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence
from itertools import groupby

import click

from chronoscene.io.wording import counted
from chronoscene.scene.grouping import grouped
from chronoscene.validation import rule
from chronoscene.validation.report.rule_list import COLOURS
from chronoscene.validation.rule import SEVERITIES, Finding, SceneReport, Summary, is_valid

MAX_PLACES = 3  # Places listed of findings that differ only in their place
MAX_CODES = 8  # Rules listed of those that were skipped for one reason
MAX_LINES = 5  # Different lines shown of one rule
MIN_WIDTH = 40  # Columns below which lines are not wrapped further


def write_text(
    reports: Sequence[SceneReport], *, strict: bool = False, width: int | None = None
) -> str:
    """Readable report of some scenes.

    Args:
        reports: Of the scenes.
        strict: Warnings make a scene invalid, too.
        width: Columns of the terminal that it goes to; None for lines of any length.
    """
    blocks = [_scene(report) for report in reports]
    if len(reports) > 1:
        bad = sum(not is_valid([r], strict=strict) for r in reports)
        blocks.append([f"{counted(len(reports), 'scene')}, {bad} not valid: {_total(reports)}"])
    return "\n\n".join("\n".join(_fit(line, width) for line in block) for block in blocks) + "\n"


def _fit(line: str, width: int | None) -> str:
    """A line, wrapped with an indent if it is too long."""
    if width is None or len(click.unstyle(line)) <= width:
        return line
    indent = " " * (len(line) - len(line.lstrip(" ")) + 4)
    wide = max(width, MIN_WIDTH)
    return textwrap.fill(
        line, wide, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False
    )


def _scene(report: SceneReport) -> list[str]:
    lines = [f"{click.style(report.name, bold=True)}: {_summary(report.summary)}"]
    for code, group in groupby(report.findings, key=lambda f: f.code):
        lines += _rule(code, list(group))
    for reason in sorted({s.reason for s in report.skipped}):
        codes = [s.code for s in report.skipped if s.reason == reason]
        rest = f" and {len(codes) - MAX_CODES} more" if len(codes) > MAX_CODES else ""
        lines.append(f"  not checked ({reason}): {', '.join(codes[:MAX_CODES])}{rest}")
    return [*lines, f"  {_total([report])}"]


def _rule(code: str, findings: list[Finding]) -> list[str]:
    """Lines of all findings of one rule in one scene."""
    first = findings[0]
    head = click.style(f"{first.severity} {code}", fg=COLOURS[first.severity])
    what = rule.explain(first)
    times = f" ({len(findings)} findings)" if len(findings) > 1 else ""
    lines = [f"  {head} {first.name}: {what}{times}"]
    folded = _fold(findings)
    lines += [f"    {line}" for line in folded[:MAX_LINES]]
    if len(folded) > MAX_LINES:
        lines.append(f"    and {len(folded) - MAX_LINES} more (--format json lists all)")
    remedies = grouped((f.remedy, f.place) for f in findings if f.remedy != rule.NOTHING)
    for remedy, places in list(remedies.items())[:MAX_LINES]:
        of = f" for {_places(places)}" if len(places) < len(findings) else ""
        lines.append(f"    to do{of}: {remedy}")
    return lines


def _fold(findings: Iterable[Finding]) -> list[str]:
    """One line for all findings that differ only in their place."""
    places = grouped((f"expected {f.expected}, found {f.found}", f.place) for f in findings)
    return [f"{_places(where)}: {text}" for text, where in places.items()]


def _places(where: Sequence[str]) -> str:
    """The first few places, and how many more there are."""
    rest = f" and {len(where) - MAX_PLACES} more" if len(where) > MAX_PLACES else ""
    return f"{', '.join(where[:MAX_PLACES])}{rest}"


def _summary(summary: Summary) -> str:
    numbers = {"image": summary.images, "camera": summary.cameras, "point": summary.points}
    parts = [f"{w}s unknown" if n is None else counted(n, w) for w, n in numbers.items()]
    if summary.periods:
        each = ", ".join(
            f"{p.title}: {p.images}" if p.test is None else f"{p.title}: {p.train} + {p.test} test"
            for p in summary.periods
        )
        parts.append(f"{counted(len(summary.periods), 'period')} ({each})")
    return ", ".join(parts)


def _total(reports: Sequence[SceneReport]) -> str:
    total = rule.counts(reports)
    nouns = {"error": "error", "warning": "warning", "info": "remark"}
    return ", ".join(counted(total[severity], nouns[severity]) for severity in SEVERITIES)
