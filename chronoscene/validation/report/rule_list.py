"""The rules for people: ``--explain``, and the page ``docs/reference/validation-rules.md``.

``python -m chronoscene.validation.report.rule_list > docs/reference/validation-rules.md`` writes
the page anew.
"""

from __future__ import annotations

import click

from chronoscene.validation.rule import GROUPS, RETIRED, Rule, Severity
from chronoscene.validation.rules import all_rules

COLOURS: dict[Severity, str] = {"error": "red", "warning": "yellow", "info": "cyan"}

INTRODUCTION = f"""\
# Validation rules

`chronoscene validate` checks a scene with the rules below, as described in
[DATASET.md](../../DATASET.md#validation). `chronoscene validate --explain CS201` prints a rule
in the terminal. Codes are stable: the code of a retired rule is never used again
({", ".join(RETIRED)}).

This page is generated: `python -m chronoscene.validation.report.rule_list >
docs/reference/validation-rules.md`. The rules of group CS1 are in the files
`chronoscene/validation/rules/cs1_*.py`, and so on; `chronoscene/validation/rule.py` explains how to
add one.
"""


def describe_rule(rule: Rule) -> str:
    """Describe a rule, with an example and a remedy."""
    head = click.style(f"{rule.severity} {rule.code}", fg=COLOURS[rule.severity])
    lines = (f"{head} {rule.name}: {rule.what}", f"  for example: {rule.bad}")
    return "\n".join([*lines, f"  to do: {rule.remedy}"]) + "\n"


def rules_page() -> str:
    """The page in Markdown: one table for each group of rules."""
    return "\n".join([INTRODUCTION, *(_group(*group) for group in GROUPS.items())]).rstrip() + "\n"


def _group(prefix: str, title: str) -> str:
    rows = [_row(rule) for rule in all_rules() if rule.code.startswith(prefix)]
    head = "| code | severity | name | what is wrong | for example | what to do |"
    return "\n".join([f"## {prefix}: {title}", "", head, "| --- " * 6 + "|", *rows, ""])


def _row(rule: Rule) -> str:
    cells = (rule.code, rule.severity, rule.name, rule.what, rule.bad, rule.remedy)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    click.echo(rules_page(), nl=False)
