"""CS30, CS31: `sparse/split.txt`; CS32: `sparse/0/test.txt`."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator

from chronoscene.formats.chronoscene import SPLIT, TEST
from chronoscene.formats.shared.grouping import NAME_PERIODS
from chronoscene.io.wording import counted, quote, shown
from chronoscene.scene.splits import DEFAULT_RULE, NameEntry, NameIndex, Problem, ProblemKind
from chronoscene.validation import rule
from chronoscene.validation.folder.names import Spellings
from chronoscene.validation.folder.scene_folder import RawScene, TextFile, derived
from chronoscene.validation.rule import Hit

_SIMILAR = re.compile(r"(splits?|periods?)(\.(txt|csv|tsv))*", re.IGNORECASE)

SPLIT_ELSEWHERE = ("split.txt", "sparse/0/split.txt", "images/split.txt")
TEST_ELSEWHERE = ("test.txt", "sparse/test.txt", "images/test.txt")


def problem_hit(file: str, problem: Problem) -> Hit:
    """A problem of the parser as a hit."""
    place = file if problem.line is None else f"{file}:{problem.line}"
    remedy = None if "DATASET.md" in problem.todo else problem.todo
    return Hit(place, problem.expected, problem.found, remedy)


def _problems(file: str, problems: Iterable[Problem], kind: ProblemKind) -> Iterator[Hit]:
    """The parser's problems of one kind."""
    return (problem_hit(file, problem) for problem in problems if problem.kind == kind)


@rule.error(
    "CS301",
    bad="`split.txt` in `sparse/0/`",
    remedy='write one line "<image name> <period id>" for each image',
)
def split_absent(scene: RawScene) -> Iterator[Hit]:
    """There is no `sparse/split.txt`, so no image has a period."""
    if scene.is_project or os.path.lexists(scene.root / SPLIT):
        return
    elsewhere = [p for p in SPLIT_ELSEWHERE if (scene.root / p).is_file()]
    if elsewhere:
        yield Hit(SPLIT, "the periods of the images", f"{elsewhere[0]} instead", "move the file")
    else:
        similar = _similar_files(scene)
        found = "no such file" + (f"; there is {shown(similar)}" if similar else "")
        yield Hit(SPLIT, "the periods of the images", found, _convert(scene))


def _similar_files(scene: RawScene) -> list[str]:
    """Files with a name similar to the right one."""
    found = []
    for folder in ("", "sparse", "sparse/0"):
        try:
            names = sorted(os.listdir(scene.root / folder))
        except OSError:
            continue
        similar = (name for name in names if _SIMILAR.fullmatch(name))
        found += [f"{folder}/{name}".removeprefix("/") for name in similar]
    return found


def _convert(scene: RawScene) -> str | None:
    """The remedy if there are a model and images, so that the command can write the file."""
    if scene.model_place is None or not (scene.root / scene.model_images).is_dir():
        return None
    return (
        'write one line "<image name> <period id>" for each image; or let chronoscene convert DIR '
        f"OUT do it, and {NAME_PERIODS}"
    )


def _not_text(scene: RawScene, file: str, text: TextFile | None) -> Iterator[Hit]:
    """A hit if the file exists but could not be read as text."""
    if text is None and os.path.lexists(scene.root / file):
        yield Hit(file, "a text file", "bytes that are not UTF-8, or no readable file")


@rule.error("CS302", bad="a spreadsheet saved under this name", remedy="save it as UTF-8 text")
def split_not_text(scene: RawScene) -> Iterator[Hit]:
    """`split.txt` is not a readable text file."""
    return _not_text(scene, SPLIT, scene.split_text)


@rule.error("CS303", bad="`a.jpg`", remedy='write "<image name> <period id>"', needs=("split",))
def split_line(scene: RawScene) -> Iterator[Hit]:
    """A line of `split.txt` does not have a name and a period."""
    return _problems(SPLIT, scene.split_problems, "fields")


@rule.error(
    "CS304",
    bad="`a.jpg 2016-05`",
    remedy="end the line with a period id: 0, 1 and so on",
    needs=("split",),
)
def split_period(scene: RawScene) -> Iterator[Hit]:
    """The last field of a line of `split.txt` is not a period id."""
    return _problems(SPLIT, scene.split_problems, "period")


@rule.error(
    "CS305",
    bad="`images.bin` has `a.jpg`, but `split.txt` does not",
    remedy="add a line for it, or correct the name in its line",
    needs=("images", "split"),
)
def image_without_period(scene: RawScene, periods: dict[str, int]) -> Iterator[Hit]:
    """A registered image is not listed in `split.txt`."""
    reported = names_on_bad_lines(scene)
    entries = {entry.line: entry for entry in scene.split or ()}
    misspelt = {name: entries[line] for line, name in meant_in_split(scene).items()}
    for name in scene.names:
        if name not in periods and name not in reported:
            found, entry = "none with this name", misspelt.get(name)
            if entry is not None:
                found += f"; line {entry.line} has {quote(entry.name)}"
            yield Hit(scene.image_place(name), f"a line in {SPLIT}", found)


@rule.error(
    "CS306",
    bad="`0001 0` with `x/0001.png` and `y/0001.png` in the model",
    remedy="write the full names relative to images/",
    needs=("images", "split"),
)
def split_ambiguous(scene: RawScene) -> Iterator[Hit]:
    """A name in `split.txt` matches several images."""
    return _problems(SPLIT, scene.split_problems, "ambiguous")


@rule.error(
    "CS307",
    bad="`a.jpg 0` and, further down, `a.jpg 1`",
    remedy="keep one of the two lines",
    needs=("images", "split"),
)
def split_contradiction(scene: RawScene) -> Iterator[Hit]:
    """`split.txt` gives an image two periods."""
    return _problems(SPLIT, scene.split_problems, "contradiction")


@rule.info(
    "CS308", bad="`a.jpg 0` twice", remedy="delete one of the lines", needs=("images", "split")
)
def split_duplicate(scene: RawScene) -> Iterator[Hit]:
    """`split.txt` lists an image twice, with the same period."""
    return _problems(SPLIT, scene.split_problems, "duplicate")


@rule.warning(
    "CS309",
    bad="`IMG_1.jpg 0` when the image is `IMG_0001.jpg`",
    remedy="correct the name, or delete the line if the image could not be registered",
    needs=("images", "split"),
)
def split_unknown(scene: RawScene) -> Iterator[Hit]:
    """`split.txt` lists an image that is not in the model; the line has no effect."""
    images, known = meant_in_split(scene), set(scene.period_ids)
    period = {entry.line: entry.period for entry in scene.split or ()}
    periods = scene.periods or {}
    worth = [
        p
        for p in scene.split_problems
        # A period or an image that gets nothing at all has its own rule.
        if (images[p.line] in periods if p.line in images else period.get(p.line or 0) in known)
    ]
    yield from _unknown_hits(SPLIT, worth, images)


@rule.info(
    "CS310",
    bad="`a.jpg 0` followed by `\\r\\n`",
    remedy="nothing to do here; save it with Unix line endings for other tools",
)
def split_line_ends(split_text: TextFile) -> Iterator[Hit]:
    """`split.txt` has Windows line endings; tools that split at spaces read a carriage return as
    part of the period."""
    if lines := split_text.text.count("\r"):
        found = f"carriage returns in {counted(lines, 'line')}"
        yield Hit(SPLIT, "Unix line endings", found, count=lines)


@rule.info(
    "CS321",
    bad="a scene without `test.txt`",
    remedy="list the test images in sparse/0/test.txt, so that everybody uses the same split",
)
def test_absent(scene: RawScene) -> Iterator[Hit]:
    """There is no `sparse/0/test.txt`; the default split is used."""
    if os.path.lexists(scene.root / TEST) or test_elsewhere(scene) or scene.has_own_tests:
        return
    size = "" if scene.tests is None else f" gives {counted(len(scene.tests), 'test view')}"
    yield Hit(TEST, "a list of test images", f"none; {DEFAULT_RULE}{size}")


@rule.warning("CS322", bad="`sparse/test.txt`", remedy="move it to sparse/0/test.txt")
def test_misplaced(scene: RawScene) -> Iterator[Hit]:
    """`test.txt` is not in `sparse/0/`, so it is not read."""
    if not os.path.lexists(scene.root / TEST):
        for place in test_elsewhere(scene):
            yield Hit(TEST, "the list of test images", f"{place} instead")


def test_elsewhere(scene: RawScene) -> list[str]:
    """Places where ``test.txt`` is, but is not read."""
    places = () if scene.has_own_tests else TEST_ELSEWHERE
    return [place for place in places if (scene.root / place).is_file()]


@rule.error("CS323", bad="a `test.txt` in an old Windows encoding", remedy="save it as UTF-8 text")
def test_not_text(scene: RawScene) -> Iterator[Hit]:
    """`test.txt` is not a readable text file."""
    return iter(()) if scene.has_own_tests else _not_text(scene, TEST, scene.test_text)


@rule.warning(
    "CS324",
    bad="`IMG_1` in `test.txt` when the image is `IMG_0001.jpg`",
    remedy="correct the name (test.txt has names only, without periods), or delete the line",
    needs=("images",),
)
def test_unknown(scene: RawScene, test: list[NameEntry]) -> Iterator[Hit]:
    """`test.txt` lists an image that is not in the model; the line has no effect, so the image that
    is meant may be a training image."""
    if not scene.names:
        return  # has its own rule
    lines = {entry.line: entry.name for entry in test}
    images = _meant(scene, scene.test_problems, lines)
    without_period = {line: text.rsplit(maxsplit=1)[0] for line, text in lines.items()}
    images |= _meant(scene, scene.test_problems, without_period)
    yield from _unknown_hits(TEST, scene.test_problems, images)


@rule.error(
    "CS325",
    bad="`0001` with `x/0001.png` and `y/0001.png` in the model",
    remedy="write the full names relative to images/",
    needs=("images", "test"),
)
def test_ambiguous(scene: RawScene) -> Iterator[Hit]:
    """A name in `test.txt` matches several images."""
    return _problems(TEST, scene.test_problems, "ambiguous")


def _meant(scene: RawScene, problems: Iterable[Problem], lines: dict[int, str]) -> dict[int, str]:
    """By line, the image that an unknown name in ``lines`` of a file probably means."""
    unknown = [p.line for p in problems if p.kind == "unknown" and p.line]
    if not unknown:
        return {}
    spellings = Spellings(scene.names)
    found = {line: spellings.find(lines[line]) for line in unknown}
    return {line: name for line, name in found.items() if name is not None}


@derived
def meant_in_split(scene: RawScene) -> dict[int, str]:
    """By line of ``split.txt``, the image that an unknown name probably means."""
    return _meant(scene, scene.split_problems, {e.line: e.name for e in scene.split or ()})


def _unknown_hits(file: str, problems: Iterable[Problem], images: dict[int, str]) -> Iterator[Hit]:
    """Unknown names, with the images that they probably mean by line."""
    for problem in problems:
        if problem.kind == "unknown":
            hit, image = problem_hit(file, problem), images.get(problem.line or 0)
            found = hit.found if image is None else f"{hit.found}; there is {quote(image)}"
            yield Hit(hit.place, hit.expected, found, hit.remedy)


@derived
def names_on_bad_lines(scene: RawScene) -> set[str]:
    """Images that have no period because of a line that has its own finding."""
    if scene.split_text is None:
        return set()
    kinds = ("fields", "period", "ambiguous")
    wrong = [p.line for p in scene.split_problems if p.line and p.kind in kinds]
    if not wrong:
        return set()
    lines = re.split("\r\n|\r|\n", scene.split_text.text)
    index = NameIndex(scene.names)
    found: set[str] = set()
    for number in wrong:
        line = lines[number - 1]
        # Some put the period first; with commas instead of spaces, the name ends at the comma.
        names = (line.rsplit(maxsplit=1)[0], line.split()[-1], re.split("[,;]", line)[0].strip())
        found.update(*(index.find(name) for name in names))
    return found
