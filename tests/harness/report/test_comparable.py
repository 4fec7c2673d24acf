"""Runs stand side by side only if what they were given is equal."""

import pytest
from made_runs import record

from chronoscene.harness.report.comparable import (
    apart,
    comparable,
    effort_of,
    several_scenes,
    with_own_titles,
)


def test_methods_with_the_same_preset_are_compared():
    runs = [record("3dgs"), record("chronogs"), record("chronogs", 1, strategy="pooled")]
    assert [*comparable(runs).values()] == [runs]


@pytest.mark.parametrize(
    "other",
    [
        {"scene": "other"},
        {"scene_hash": "other"},
        {"split_hash": "other"},
        {"max_width": 800},
        {"fitted": "left half"},
        {"iterations": 7},
        {"iterations": None},
        {"variant": "budget=90s"},
    ],
)
def test_different_settings_are_not_compared(other):
    assert len(comparable([record(), record("3dgs", **other)])) == 2


def test_equal_budgets_are_compared_on_one_device_whatever_the_preset():
    runs = [record(preset=p, variant="sh_degree=2,budget=90s") for p in ("fast", "paper")]
    assert len(comparable(runs)) == 1
    assert effort_of(runs[0]) == "90s of training on cpu (Test, 2 threads)"
    assert len(comparable([runs[0], runs[0].model_copy(update={"device": "cuda"})])) == 2


def test_presets_of_one_length_are_compared_and_others_are_not():
    full = record(preset="full", iterations=3_000)
    assert len(comparable([full, record(preset="balanced", iterations=3_000)])) == 1
    assert effort_of(full) == "3,000 training steps"
    paper = [record("4dgs", preset="paper", iterations=n) for n in (18_000, 40_000)]
    assert len(comparable(paper)) == 2


def test_a_budget_for_each_model_is_that_of_all_models():
    each = record(strategy="separate", variant="budget=45s,separate_iterations=each")
    assert effort_of(each) == effort_of(record(variant="budget=90s"))
    pooled = record(strategy="pooled", variant="budget=45s,separate_iterations=each")
    assert effort_of(pooled) == effort_of(record(variant="budget=45s"))
    assert effort_of(record(variant="budget=1.2.3s")) == "100 training steps"


def test_tests_of_one_scene_have_names_of_their_own():
    quay = record("3dgs", scene="quay", scene_hash="q", max_width=800)
    runs = [record(), record("3dgs", max_width=800), quay]
    assert [run.scene for run in apart(runs)] == ["plaza [width 1600]", "plaza [width 800]", "quay"]
    assert apart(runs[1:]) == runs[1:] and apart(apart(runs)) == apart(runs)
    both = [record(), record(split_hash="0" * 8, max_width=800)]
    assert apart(both)[1].scene == "plaza [width 800, split 000000]"


def test_a_scene_with_two_names_is_one_scene():
    runs = [record(), record(scene="copy"), record(scene="quay", scene_hash="q")]
    found = apart(runs)
    names = ["plaza [name plaza]", "plaza [name copy]", "quay"]
    assert [run.scene for run in found] == names and apart(found) == found
    assert not several_scenes(names)
    assert found[1].notices == [
        "plaza: runs with different names of the scene (plaza, copy) are not compared, and stand "
        "apart"
    ]
    narrow = [*found, *apart([record(max_width=800), record(max_width=40)])]
    assert apart(narrow) == narrow


def test_a_mean_over_scenes_needs_one_test_of_each():
    assert several_scenes(["plaza", "quay [width 800]"]) and not several_scenes(["plaza"])
    assert not several_scenes(["plaza [width 800]", "plaza [width 40]", "quay"])


def test_an_option_of_a_method_is_no_effort():
    assert len(comparable([record(), record("3dgs", variant="sh_degree=2")])) == 1


def test_titles_that_methods_share_name_the_method():
    runs = [
        record("a", title="T"),
        record("b", title="T"),
        record("a", seed=1, title="T"),
        record("c"),
        record("c", preset="paper"),
    ]
    assert [run.title for run in with_own_titles(runs)] == ["T [a]", "T [b]", "T [a]", "C", "C"]
