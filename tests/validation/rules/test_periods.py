import re

import pytest

SPLIT, TEST = "sparse/split.txt", "sparse/0/test.txt"


@pytest.mark.parametrize("ids", [(0, 2), (1, 2), (2016, 2023), (0, 999_999_999)])
def test_period_ids(scene, ids):
    lines = (re.sub(r"\d+$", lambda m: str(ids[int(m[0])]), s) for s in scene.lines(SPLIT))
    scene.write(SPLIT, lines)
    scene.expect("CS401", place=SPLIT, found=f"{ids[0]}, {ids[1]}")


def test_empty_split(scene):
    scene.write(SPLIT, "")
    scene.expect("CS401", place=SPLIT, found="none", also={"CS305"})


def test_period_empty(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "c000.png 2"])
    scene.expect("CS402", place=SPLIT, found="none", also={"CS309"})


def test_period_without_train(scene):
    scene.write(TEST, [f"b{i:03d}.png" for i in range(7)] + ["a003.png"])
    scene.expect("CS403", place=TEST, found="none")


def test_period_without_test(scene):
    scene.write(TEST, ["a003.png"])
    report = scene.expect("CS404", place=TEST, found="none")
    finding = next(f for f in report.findings if f.code == "CS404")
    assert finding.expected == "a test view in period 1"


def test_no_test_view(scene):
    scene.write(TEST, "")
    scene.expect("CS407", place=TEST, found="none")


def test_period_with_few_views(scene):
    scene.write(TEST, ["a003.png", "b000.png", "b001.png", "b002.png"])
    scene.expect("CS405", place="period 1", found="4 training views")


def test_single_period(scene):
    scene.write(SPLIT, [line.replace(" 1", " 0") for line in scene.lines(SPLIT)])
    report = scene.validate()
    assert {f.code for f in report.findings} == {"CS406"}


def test_summary_counts_views(scene):
    periods = scene.validate().summary.periods
    assert [(p.id, p.images, p.train, p.test) for p in periods] == [(0, 7, 6, 1), (1, 7, 6, 1)]
