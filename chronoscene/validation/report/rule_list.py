"""Table of rules: ``python -m chronoscene.validation.report.rule_list`` prints it."""

from __future__ import annotations

from chronoscene.validation.rule import GROUPS, Rule
from chronoscene.validation.rules import all_rules


def rules_markdown() -> str:
    """One table for each group of rules."""
    return "\n".join(_group(prefix, title) for prefix, title in GROUPS.items())


def _group(prefix: str, title: str) -> str:
    rows = [_row(rule) for rule in all_rules() if rule.code.startswith(prefix)]
    head = "| code | severity | name | what is wrong | for example | what to do |"
    return "\n".join([f"**{prefix}: {title}**", "", head, "| --- " * 6 + "|", *rows, ""])


def _row(rule: Rule) -> str:
    cells = (rule.code, rule.severity, rule.name, rule.what, rule.bad, rule.remedy)
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


if __name__ == "__main__":
    print(rules_markdown())
