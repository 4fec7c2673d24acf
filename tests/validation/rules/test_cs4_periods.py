import re

import pytest

SPLIT, TEST = "sparse/split.txt", "sparse/0/test.txt"


@pytest.mark.parametrize("ids", [(0, 2), (1, 2), (2016, 2023), (0, 999_999_999)])
def test_period_ids(scene, ids):
    lines = (re.sub(r"\d+$", lambda m: str(ids[int(m[0])]), s) for s in scene.lines(SPLIT))
    scene.write(SPLIT, lines)
    scene.expect("CS401", place=SPLIT, found=f"{ids[0]}, {ids[1]}")


def test_an_id_of_one_line_may_be_a_typing_error(scene):
    scene.write(SPLIT, [line.replace("a001.png 0", "a001.png 12") for line in scene.lines(SPLIT)])
    also = {"CS404", "CS405"}
    report = scene.expect("CS401", place=f"{SPLIT}:2", found="0, 1, 12; few lines", also=also)
    (finding,) = [f for f in report.findings if f.code == "CS401"]
    assert finding.remedy.startswith("correct the id if it is wrong; else number the periods")


def test_empty_split(scene):
    scene.write(SPLIT, "")
    scene.expect("CS401", place=SPLIT, found="none", also={"CS305"})


def test_period_empty(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "c000.png 2"])
    scene.expect("CS402", place=SPLIT, found="none")


def test_period_without_train(scene):
    scene.write(TEST, [f"b{i:03d}.png" for i in range(9)] + ["a003.png"])
    scene.expect("CS403", place=TEST, found="none")


def test_period_of_one_image(make_scene):
    """Without test.txt it is a test image; the way out is not in that file."""
    report = make_scene({"a.png": 0, "b0.png": 1, "b1.png": 1}).validate()
    (finding,) = [f for f in report.findings if f.code == "CS403"]
    assert (finding.place, finding.found) == ("period 0", "1 image, for testing")
    assert finding.remedy == "register more images of this period"


def test_period_without_test(scene):
    scene.write(TEST, ["a003.png"])
    report = scene.expect("CS404", place=TEST, found="none")
    finding = next(f for f in report.findings if f.code == "CS404")
    assert finding.expected == "a test view in period 1"


def test_no_test_view(scene):
    scene.write(TEST, "")
    scene.expect("CS407", place=TEST, found="none")


def test_period_with_few_views(scene):
    scene.write(TEST, [f"{p}{i:03d}.png" for p, n in (("a", 3), ("b", 5)) for i in range(n)])
    scene.expect("CS405", place="period 1", found="4 training views")


def codes(scene):
    return {finding.code for finding in scene.validate().findings}


@pytest.mark.parametrize(("train", "few"), [(4, True), (5, False)])
def test_five_training_views_are_enough(scene, train, few):
    tests = (("a", 3), ("b", 9 - train))
    scene.write(TEST, [f"{p}{i:03d}.png" for p, n in tests for i in range(n)])
    assert ("CS405" in codes(scene)) == few


def test_single_period(scene):
    scene.write(SPLIT, [line.replace(" 1", " 0") for line in scene.lines(SPLIT)])
    report = scene.validate()
    assert {f.code for f in report.findings} == {"CS406"}


def test_a_label_of_two_periods(scene):
    scene.write("sparse/periods.json", '[{"id": 0, "label": "May"}, {"id": 1, "label": "May"}]')
    scene.expect("CS410", place="sparse/periods.json", found="'May' 2 times")


def test_summary_counts_views(scene):
    periods = scene.validate().summary.periods
    assert [(p.id, p.images, p.train, p.test) for p in periods] == [(0, 9, 6, 3), (1, 9, 6, 3)]


def names(**numbers):
    """Image names to periods: so many images of period 0 by ``a``, of period 1 by ``b``."""
    return {f"{p}{i:03d}.png": "ab".index(p) for p, n in numbers.items() for i in range(n)}


def test_test_share(make_scene):
    tests = [f"a{i:03d}" for i in range(12)] + ["b000"]
    scene = make_scene(names(a=40, b=40), tests=tests)
    report = scene.expect("CS408", place="period 1", found="1", also={"CS705"})
    finding = next(f for f in report.findings if f.code == "CS408")
    assert finding.expected == "about 6 test views of 40 images"


@pytest.mark.parametrize(
    ("images", "tests", "uneven"),
    [
        ((40, 40), (11, 2), True),  # less than a third of 6.5
        ((40, 40), (10, 2), False),
        ((40, 40), (7, 1), True),  # three fewer than 4
        ((40, 40), (6, 1), False),
        ((80, 8), (7, 4), True),  # three more than 1
        ((80, 8), (8, 4), False),
    ],
)
def test_limits_of_an_uneven_share(make_scene, images, tests, uneven):
    listed = [f"{p}{i:03d}" for p, n in zip("ab", tests, strict=True) for i in range(n)]
    scene = make_scene(names(a=images[0], b=images[1]), tests=listed)
    assert ("CS408" in codes(scene)) == uneven


def test_few_test_views_of_few_images_are_silent(make_scene):
    scene = make_scene(names(a=40, b=8), tests=[f"a{i:03d}" for i in range(10)] + ["b000"])
    assert {f.code for f in scene.validate().findings} == {"CS507", "CS705"}


def test_periods_unequal(make_scene):
    scene = make_scene(names(a=70, b=7), tests=[f"a{i:03d}" for i in range(9)] + ["b000"])
    scene.expect("CS409", place="period 1", found="6", also={"CS705"})


def test_a_tenth_of_the_training_views_is_enough(make_scene):
    scene = make_scene(names(a=69, b=7), tests=[f"a{i:03d}" for i in range(9)] + ["b000"])
    assert "CS409" not in codes(scene)  # 60 and 6
