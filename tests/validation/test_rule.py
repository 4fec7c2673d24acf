"""The table of rules, and how rules are chosen."""

from pathlib import Path

import pytest

from chronoscene.errors import ConfigError
from chronoscene.validation import rule
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import RULES
from chronoscene.validation.rules import all_rules, choose_rules

ERRORS = """
001 002 004 005 007 009
101 102 103 105 106 107 108 111 112 121 125 131 132 133 141 143
201 203 204 206 208 241 242
301 302 303 304 305 306 307 323 325
401 402 403
501 502 504 505 512 514
601 602
"""
REMARKS = """
006
104 134 137
202 207 211 213
308 310 321
406 409
507 509 525
703 705 706
"""
"""Numbers of the rules of these severities, on which the exit status depends; others warn."""


def codes(rules):
    return [r.code for r in rules]


def test_every_rule_is_documented():
    for r in all_rules():
        assert r.what.endswith("."), r
        assert r.remedy and not r.remedy.endswith("."), r
        assert r.bad, r


def test_every_rule_has_a_test_that_breaks_it():
    tests = "".join(p.read_text() for p in (Path(__file__).parent / "rules").glob("test_*.py"))
    assert [r.code for r in all_rules() if f'"{r.code}"' not in tests] == []


def test_severities():
    for severity, numbers in (("error", ERRORS), ("info", REMARKS)):
        found = [r.code for r in all_rules() if r.severity == severity]
        assert found == [f"CS{number}" for number in numbers.split()]


def test_every_need_is_an_attribute_with_a_reason(tmp_path):
    scene = RawScene(tmp_path)
    for r in all_rules():
        for attribute in r.needs:
            assert hasattr(RawScene, attribute), (r.code, attribute)
            assert scene.reason(attribute), (r.code, attribute)


def test_codes_are_sorted_and_names_unique():
    rules = all_rules()
    assert codes(rules) == sorted(RULES)
    assert len({r.name for r in rules}) == len(rules)


def test_a_code_cannot_be_given_twice():
    with pytest.raises(AssertionError, match="CS201"):
        rule.info("CS201", remedy="", bad="")


def test_a_name_cannot_be_given_twice():
    def image_missing(scene):
        return ()

    with pytest.raises(AssertionError, match="image-missing"):
        rule.info("CS299", remedy="", bad="")(image_missing)


def test_choose_all():
    assert choose_rules() == all_rules()


@pytest.mark.parametrize(
    "select", [["CS201"], ["cs201"], ["image-missing"], [" CS201 "], ["CS201", "CS201"]]
)
def test_select_one(select):
    assert codes(choose_rules(select)) == ["CS201"]


def test_select_a_group():
    chosen = codes(choose_rules(["CS2", "CS301"]))
    assert chosen[0] == "CS201" and chosen[-1] == "CS301"
    assert all(c.startswith("CS2") for c in chosen[:-1]) and len(chosen) > 5


def test_ignore_wins_over_select():
    assert codes(choose_rules(["CS201", "CS202"], ["CS202"])) == ["CS201"]


def test_ignore_alone():
    assert not [c for c in codes(choose_rules([], ["CS7"])) if c.startswith("CS7")]


@pytest.mark.parametrize("text", ["CS999", "CS800", "nonsense", "", "2"])
def test_unknown_code(text):
    todo = r"; choose from CS0 \(Folder\), CS1 \(COLMAP model\), .* CS7 \(Released"
    with pytest.raises(ConfigError, match=f"--select: expected rule codes.*{todo}"):
        choose_rules([text])


@pytest.mark.parametrize(("text", "near"), [("CS299", "CS2"), ("cs2x", "CS2"), ("CS0091", "CS009")])
def test_unknown_code_of_a_family(text, near):
    with pytest.raises(ConfigError, match=f"; did you mean {near}"):
        choose_rules([text])


def test_unknown_name_gets_a_hint():
    with pytest.raises(ConfigError, match="did you mean image-missing"):
        choose_rules([], ["image-mising"])
