"""DATASET.md has the table of rules as the code has it."""

from pathlib import Path

from chronoscene.validation.report.rule_list import rules_markdown
from chronoscene.validation.rules import all_rules

DATASET = Path(__file__).parents[3] / "DATASET.md"


def test_table_in_the_format_description():
    section = DATASET.read_text(encoding="utf-8").split("## Validation rules", 1)[1]
    assert rules_markdown().strip() in section, (
        "renew the tables: python -m chronoscene.validation.report.rule_list"
    )


def test_every_rule_has_one_row():
    rows = [line for line in rules_markdown().splitlines() if line.startswith("| CS")]
    assert [row.split(" | ")[0] for row in rows] == [f"| {r.code}" for r in all_rules()]
    assert {row.count(" | ") for row in rows} == {5}
