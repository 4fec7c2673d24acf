"""CS4: periods, and the views in them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from statistics import median

from chronoscene.errors import ChronoSceneError
from chronoscene.formats.chronoscene import PERIODS, SPLIT, TEST
from chronoscene.io.wording import counted
from chronoscene.scene.splits import SplitEntry, check_period_ids
from chronoscene.validation import rule
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit
from chronoscene.validation.rules.cs3_split import meant_in_split, names_on_bad_lines, problem_hit

MIN_TRAIN = 5  # Training views below which a period can hardly be reconstructed
UNEVEN = 3  # Ratio between the number of test views of a period and its fair share
MIN_OFF = 3  # Deviation from the fair share, in test views, that is worth a warning
UNEQUAL = 10  # Ratio between the numbers of training views of two periods
RARE = 4  # Ratio of lines of the usual period to those of one whose id may be a typing error

NUMBER = "number the periods from 0 without gaps; put labels and dates into sparse/periods.json"
REGISTER_MORE = "register more images of this period"


@rule.error("CS401", bad="ids 2016 and 2023; ids 0 and 2", remedy=NUMBER)
def period_ids(scene: RawScene, split: list[SplitEntry]) -> Iterator[Hit]:
    """The period ids are not 0..T-1."""
    if not split and any(p.kind in ("fields", "period") for p in scene.split_problems):
        return  # no line could be read, which has its own rules
    if names_on_bad_lines(scene):
        return  # periods may be missing because of these lines
    doubtful = doubtful_ids(split)
    for problem in check_period_ids(split, {entry.period for entry in split}):
        hit = problem_hit(SPLIT, problem)
        if not doubtful:
            yield Hit(hit.place, hit.expected, hit.found)
        for line in (entry.line for entry in split if entry.period in doubtful):
            place, todo = f"{SPLIT}:{line}", f"correct the id if it is wrong; else {NUMBER}"
            yield Hit(place, hit.expected, f"{hit.found}; few lines have the id of this one", todo)


def doubtful_ids(split: Sequence[SplitEntry]) -> set[int]:
    """Find ids of so few lines that they may be typing errors."""
    counts = Counter(entry.period for entry in split)
    usual = median(counts.values()) if counts else 0
    return {period for period, n in counts.items() if n == 1 or RARE * n < usual}


@rule.error(
    "CS402",
    bad="COLMAP could not register any photo of period 2",
    remedy="register images of this period, or delete its lines and number the others from 0",
    needs=("images",),
)
def period_empty(scene: RawScene, split: list[SplitEntry]) -> Iterator[Hit]:
    """A period has no registered image."""
    if not scene.names:
        return  # has its own rule
    images = meant_in_split(scene)
    ambiguous = {p.line for p in scene.split_problems if p.kind == "ambiguous"}
    listed = {entry.period for entry in split}
    listed -= {entry.period for entry in split if entry.line in images or entry.line in ambiguous}
    for period in sorted(listed - set(scene.period_ids)):
        yield Hit(SPLIT, f"a registered image of period {period}", "none")


@rule.error(
    "CS403",
    bad="all images of period 1 are in `test.txt`",
    remedy="remove some of its images from sparse/0/test.txt",
    needs=("tests",),
)
def period_without_train(scene: RawScene) -> Iterator[Hit]:
    """A period has no training view."""
    for period, (train, test) in _views(scene).items():
        if train == 0 and scene.test is None:  # then test.txt is not there to be corrected
            place, found = f"period {period}", f"{counted(test, 'image')}, for testing"
            yield Hit(place, "two or more images, one for training", found, REGISTER_MORE)
        elif train == 0:
            yield Hit(TEST, f"a training view in period {period}", "none")


@rule.warning(
    "CS404",
    bad="a `test.txt` with images of period 0 only",
    remedy="add some of its images to sparse/0/test.txt",
    needs=("tests",),
)
def period_without_test(scene: RawScene) -> Iterator[Hit]:
    """A period has no test view, so quality in it cannot be measured."""
    for period, (_train, test) in _views(scene).items():
        if test == 0 and scene.tests:
            yield Hit(TEST, f"a test view in period {period}", "none")


@rule.warning(
    "CS405",
    what=f"A period has fewer than {MIN_TRAIN} training views.",
    bad="a period of three photos",
    remedy=REGISTER_MORE,
    needs=("tests",),
)
def period_few_views(scene: RawScene) -> Iterator[Hit]:
    if len(scene.periods or ()) < len(scene.names):
        return  # images without a period have their own rule; they may belong here
    for period, (train, _test) in _views(scene).items():
        if 0 < train < MIN_TRAIN:
            found = counted(train, "training view")
            yield Hit(f"period {period}", f"at least {MIN_TRAIN} training views", found)


@rule.info(
    "CS406",
    bad="a `split.txt` with period 0 only",
    remedy="nothing to do, unless there should be more periods",
)
def single_period(scene: RawScene, periods: dict[str, int]) -> Iterator[Hit]:
    """All images are of one period, so nothing can change."""
    if len(scene.period_ids) == 1 and len(periods) == len(scene.names):
        yield Hit(scene.period_place, "two or more periods", "one")


@rule.warning(
    "CS407",
    bad="an empty `test.txt`",
    remedy="list images of every period in sparse/0/test.txt, or delete it for the default split; "
    "nothing to do where all photos are for training",
)
def no_test_view(scene: RawScene, tests: set[str]) -> Iterator[Hit]:
    """There is no test view at all, so trainings on the scene are not scored."""
    if scene.periods and not tests:
        yield Hit(TEST, "test views", "none that is an image of the model")


@rule.warning(
    "CS408",
    bad="20 of 100 images are test views in period 0, 2 of 100 in period 1",
    remedy="put every n-th image of each period, with the same n, into test.txt (chronoscene "
    "split writes such a list)",
    needs=("tests",),
)
def test_share(scene: RawScene) -> Iterator[Hit]:
    """The test views are spread unevenly: a period has far fewer or far more of them than its
    share, so a mean over all views does not represent the periods of the scene."""
    views = _views(scene)
    if any(train == 0 for train, _ in views.values()):
        return  # has its own rule
    total, tests = sum(map(sum, views.values())), sum(test for _, test in views.values())
    for period, (train, test) in views.items():
        fair = tests * (train + test) / max(1, total)
        uneven = test * UNEVEN < fair or test > fair * UNEVEN
        if test and uneven and abs(test - fair) >= MIN_OFF:
            expected = f"about {fair:.0f} test views of {train + test} images"
            yield Hit(f"period {period}", expected, str(test))


@rule.info(
    "CS409",
    bad="900 images of 2023, 60 of 2016",
    remedy="nothing to do; look at the scores of each period, not only at the mean over all views",
    needs=("tests",),
)
def periods_unequal(scene: RawScene) -> Iterator[Hit]:
    """A period has less than a tenth of the training views of another period."""
    train = {period: views[0] for period, views in _views(scene).items()}
    most = max(train.values(), default=0)
    for period, number in train.items():
        if 0 < number * UNEQUAL < most:
            yield Hit(f"period {period}", f"at least a tenth of {most} training views", str(number))


@rule.warning(
    "CS410",
    bad='two periods with the label "May"',
    remedy="give each period a label of its own in sparse/periods.json",
    needs=("periods",),
)
def label_twice(scene: RawScene) -> Iterator[Hit]:
    """Several periods have the same label, so figures and pages do not tell them apart."""
    with suppress(ChronoSceneError):  # has its own rule
        for label, count in Counter(p.label for p in scene.period_table()).items():
            if count > 1:
                yield Hit(PERIODS, "a label of its own for each period", f"{label!r} {count} times")


def _views(scene: RawScene) -> dict[int, tuple[int, int]]:
    """Numbers of training and test views by period."""
    assert scene.periods is not None and scene.tests is not None
    views = {period: [0, 0] for period in scene.period_ids}
    for name, period in scene.periods.items():
        views[period][name in scene.tests] += 1
    return {period: (train, test) for period, (train, test) in views.items()}
