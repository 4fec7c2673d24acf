"""docs/reference/validation-rules.md lists the rules as the code has them."""

from pathlib import Path

from chronoscene.validation.report.rule_list import rules_page
from chronoscene.validation.rules import all_rules

PAGE = Path(__file__).parents[3] / "docs/reference/validation-rules.md"


def test_the_page_is_current():
    renew = f"python -m chronoscene.validation.report.rule_list > {PAGE}"
    assert PAGE.read_text(encoding="utf-8") == rules_page(), renew


def test_every_rule_has_one_row():
    rows = [line for line in rules_page().splitlines() if line.startswith("| CS")]
    assert [row.split(" | ")[0] for row in rows] == [f"| {r.code}" for r in all_rules()]
    assert {row.count(" | ") for row in rows} == {5}
