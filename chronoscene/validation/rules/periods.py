"""CS4: periods, and views in them."""

from __future__ import annotations

from collections.abc import Iterator

from chronoscene.formats.chronoscene import SPLIT, TEST
from chronoscene.io.wording import counted
from chronoscene.scene.splits import check_period_ids
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.split_file import in_other_words, meant_in_split, problem_hit
from chronoscene.validation.scene_folder import RawScene

FEW = 5
"""Training views below which a period can hardly be reconstructed."""

UNEVEN = 3
"""Ratio between the test views of a period and its share of them."""

FEWEST_OFF = 3
"""Test views too few or too many that are worth a word."""

UNEQUAL = 10
"""Ratio between the training views of two periods."""


@rule(
    "CS401",
    "period-ids",
    "error",
    what="The period ids are not 0..T-1.",
    remedy="number the periods from 0 without gaps; labels and dates go to sparse/periods.json",
    bad="ids 2016 and 2023; ids 0 and 2",
    needs=("split",),
)
def period_ids(scene: RawScene) -> Iterator[Hit]:
    entries = scene.split or []
    if not entries and any(p.kind in ("fields", "period") for p in scene.split_problems):
        return  # no line could be read, which is reported
    if in_other_words(scene):
        return  # nor is known what is missing
    for problem in check_period_ids(entries, {entry.period for entry in entries}):
        hit = problem_hit(SPLIT, problem)
        yield Hit(hit.place, hit.expected, hit.found)


@rule(
    "CS402",
    "period-empty",
    "error",
    what="A period has no registered image.",
    remedy="register images of this period, or take it out and renumber the others",
    bad="COLMAP could not register any photo of period 2",
    needs=("images", "split"),
)
def period_empty(scene: RawScene) -> Iterator[Hit]:
    if not scene.names:
        return  # an error of its own
    images = meant_in_split(scene)
    listed = {entry.period for entry in scene.split or ()}
    listed -= {entry.period for entry in scene.split or () if entry.line in images}
    ambiguous = {p.line for p in scene.split_problems if p.kind == "ambiguous"}
    listed -= {entry.period for entry in scene.split or () if entry.line in ambiguous}
    for period in sorted(listed - set(scene.period_ids)):
        yield Hit(SPLIT, f"a registered image of period {period}", "none")


@rule(
    "CS403",
    "period-without-train",
    "error",
    what="A period has no training view.",
    remedy="take some of its images out of test.txt",
    bad="all images of period 1 are in `test.txt`",
    needs=("tests",),
)
def period_without_train(scene: RawScene) -> Iterator[Hit]:
    for period, (train, _test) in _views(scene).items():
        if train == 0:
            yield Hit(TEST, f"a training view in period {period}", "none")


@rule(
    "CS404",
    "period-without-test",
    "warning",
    what="A period has no test view, so quality in it cannot be measured.",
    remedy="add some of its images to test.txt",
    bad="`test.txt` with images of period 0 only",
    needs=("tests",),
)
def period_without_test(scene: RawScene) -> Iterator[Hit]:
    for period, (_train, test) in _views(scene).items():
        if test == 0 and scene.tests:
            yield Hit(TEST, f"a test view in period {period}", "none")


@rule(
    "CS405",
    "period-few-views",
    "warning",
    what=f"A period has fewer than {FEW} training views.",
    remedy="register more images of this period",
    bad="a period of three photos",
    needs=("tests",),
)
def period_few_views(scene: RawScene) -> Iterator[Hit]:
    if len(scene.periods or ()) < len(scene.names):
        return  # images without a period are an error; they may belong here
    for period, (train, _test) in _views(scene).items():
        if 0 < train < FEW:
            place = f"period {period}"
            yield Hit(place, f"{FEW} training views or more", counted(train, "training view"))


@rule(
    "CS406",
    "single-period",
    "info",
    what="All images are of one period, so nothing can change.",
    remedy="nothing to do, unless split.txt should name more periods",
    bad="a `split.txt` with period 0 only",
    needs=("periods",),
)
def single_period(scene: RawScene) -> Iterator[Hit]:
    if len(scene.period_ids) == 1 and len(scene.periods or ()) == len(scene.names):
        yield Hit(SPLIT, "two periods or more", "one")


@rule(
    "CS407",
    "no-test-view",
    "error",
    what="There is no test view at all, so nothing can be measured. Benchmarks refuse the scene.",
    remedy="list images of every period in sparse/0/test.txt, or delete it for the default split",
    bad="an empty `test.txt`",
    needs=("tests",),
)
def no_test_view(scene: RawScene) -> Iterator[Hit]:
    if scene.periods and not scene.tests:
        yield Hit(TEST, "test views", "none that names an image of the model")


@rule(
    "CS408",
    "test-share",
    "warning",
    what="The test views are spread unevenly: a period has far fewer or far more of them than its "
    "share, so a mean over all views speaks for other periods than the scene.",
    remedy="take every n-th image of each period, with one n, into test.txt",
    bad="20 of 100 images are test views in period 0, 2 of 100 in period 1",
    needs=("tests",),
)
def test_share(scene: RawScene) -> Iterator[Hit]:
    views = _views(scene)
    if any(train == 0 for train, _ in views.values()):
        return  # an error already
    total, tests = sum(map(sum, views.values())), sum(test for _, test in views.values())
    for period, (train, test) in views.items():
        fair = tests * (train + test) / max(1, total)
        uneven = test * UNEVEN < fair or test > fair * UNEVEN
        if test and uneven and abs(test - fair) >= FEWEST_OFF:
            expected = f"about {fair:.0f} test views of {train + test} images"
            yield Hit(f"period {period}", expected, str(test))


@rule(
    "CS409",
    "periods-unequal",
    "info",
    what="A period has less than a tenth of the training views of another one.",
    remedy="nothing to do; sample the periods equally in training, and look at each period's score",
    bad="900 images of 2023, 60 of 2016",
    needs=("tests",),
)
def periods_unequal(scene: RawScene) -> Iterator[Hit]:
    train = {period: views[0] for period, views in _views(scene).items()}
    most = max(train.values(), default=0)
    for period, number in train.items():
        if 0 < number * UNEQUAL < most:
            yield Hit(f"period {period}", f"a tenth of {most} training views", str(number))


def _views(scene: RawScene) -> dict[int, tuple[int, int]]:
    """Numbers of training and test views by period."""
    assert scene.periods is not None and scene.tests is not None
    views = {period: [0, 0] for period in scene.period_ids}
    for name, period in scene.periods.items():
        views[period][name in scene.tests] += 1
    return {period: (train, test) for period, (train, test) in views.items()}
