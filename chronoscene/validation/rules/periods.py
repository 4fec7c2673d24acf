"""CS4: periods, and views in them."""

from __future__ import annotations

from collections.abc import Iterator

from chronoscene.formats.chronoscene import SPLIT, TEST
from chronoscene.splits import check_period_ids
from chronoscene.validation.finding import Hit, counted
from chronoscene.validation.raw_scene import RawScene
from chronoscene.validation.rule import rule
from chronoscene.validation.rules.split import problem_hit

FEW = 5
"""Training views below which a period can hardly be reconstructed."""


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
    listed = {entry.period for entry in scene.split or ()}
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
    if len(scene.period_ids) == 1:
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


def _views(scene: RawScene) -> dict[int, tuple[int, int]]:
    """Numbers of training and test views by period."""
    assert scene.periods is not None and scene.tests is not None
    views = {period: [0, 0] for period in scene.period_ids}
    for name, period in scene.periods.items():
        views[period][name in scene.tests] += 1
    return {period: (train, test) for period, (train, test) in views.items()}
