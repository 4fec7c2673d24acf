"""CS30 and CS31: ``sparse/split.txt``."""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Iterator

from chronoscene.formats.chronoscene import SPLIT
from chronoscene.io.wording import counted, quote, shown
from chronoscene.scene.splits import NameIndex, Problem, ProblemKind
from chronoscene.validation.checks.spelling import Spellings
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene, TextFile

_SIMILAR = re.compile(r"(splits?|periods?)(\.(txt|csv|tsv))*", re.IGNORECASE)

ELSEWHERE = ("split.txt", "sparse/0/split.txt", "images/split.txt")


def problem_hit(file: str, problem: Problem) -> Hit:
    """A problem of the parser as a hit."""
    place = file if problem.line is None else f"{file}:{problem.line}"
    remedy = None if "DATASET.md" in problem.todo else problem.todo
    return Hit(place, problem.expected, problem.found, remedy)


def problem_hits(file: str, problems: Iterable[Problem], kind: ProblemKind) -> Iterator[Hit]:
    """The problems of one kind as hits."""
    return (problem_hit(file, problem) for problem in problems if problem.kind == kind)


def meant(scene: RawScene, problems: Iterable[Problem], lines: dict[int, str]) -> dict[int, str]:
    """By line, the image that a name which is none probably means.

    Args:
        scene: The scene.
        problems: Of one file.
        lines: The names in this file, by line.
    """
    unknown = [p.line for p in problems if p.kind == "unknown" and p.line]
    if not unknown:
        return {}
    spellings = Spellings(scene.names)
    found = {line: spellings.find(lines[line]) for line in unknown}
    return {line: name for line, name in found.items() if name is not None}


def meant_in_split(scene: RawScene) -> dict[int, str]:
    """The same for ``split.txt``."""
    return meant(scene, scene.split_problems, {e.line: e.name for e in scene.split or ()})


def unknown_hits(file: str, problems: Iterable[Problem], images: dict[int, str]) -> Iterator[Hit]:
    """Names that are no images, with those that they probably mean by line."""
    for problem in problems:
        if problem.kind == "unknown":
            hit, image = problem_hit(file, problem), images.get(problem.line or 0)
            found = hit.found if image is None else f"{hit.found}; there is {quote(image)}"
            yield Hit(hit.place, hit.expected, found, hit.remedy)


def in_other_words(scene: RawScene) -> set[str]:
    """Images without a period because of a line that has a finding of its own."""
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
        # Some have the period in front; with commas instead of blanks the name ends there.
        names = (line.rsplit(maxsplit=1)[0], line.split()[-1], re.split("[,;]", line)[0].strip())
        found.update(*(index.find(name) for name in names))
    return found


def not_text(scene: RawScene, file: str, text: TextFile | None) -> Iterator[Hit]:
    """A hit if the file is there and could not be read as text."""
    if text is None and os.path.lexists(scene.root / file):
        yield Hit(file, "a text file", "bytes that are not UTF-8, or no file to read")


@rule(
    "CS301",
    "split-absent",
    "error",
    what="There is no `sparse/split.txt`, so no image has a period.",
    remedy='write it: "<image name> <period id>" for each image',
    bad="`split.txt` in `sparse/0/`",
)
def split_absent(scene: RawScene) -> Iterator[Hit]:
    path = scene.root / SPLIT
    if not os.path.lexists(path):
        elsewhere = [p for p in ELSEWHERE if (scene.root / p).is_file()]
        if elsewhere:
            yield Hit(SPLIT, "the periods of the images", f"{elsewhere[0]} instead", "move it")
        else:
            found, similar = "no such file", _similar_files(scene)
            if similar:
                found += f"; there is {shown(similar)}"
            yield Hit(SPLIT, "the periods of the images", found, _by_folders(scene))


def _similar_files(scene: RawScene) -> list[str]:
    """Files that are called nearly like the right one."""
    found = []
    for folder in ("", "sparse", "sparse/0"):
        try:
            names = sorted(os.listdir(scene.root / folder))
        except OSError:
            continue
        similar = (name for name in names if _SIMILAR.fullmatch(name))
        found += [f"{folder}/{name}".removeprefix("/") for name in similar]
    return found


def _by_folders(scene: RawScene) -> str | None:
    """What to do where the folders of the images may be the periods."""
    folders = sorted({file.split("/")[0] for file in scene.files if "/" in file})
    if len(folders) < 2 or not all("/" in file for file in scene.files):
        return None
    return (
        'write it: "<image name> <period id>" for each image; if the folders '
        f"{shown(folders)} are the periods, chronoscene convert DIR OUT makes a scene of them"
    )


@rule(
    "CS302",
    "split-not-text",
    "error",
    what="`split.txt` is not a readable text file.",
    remedy="save it as UTF-8",
    bad="a spreadsheet saved under this name",
)
def split_not_text(scene: RawScene) -> Iterator[Hit]:
    return not_text(scene, SPLIT, scene.split_text)


@rule(
    "CS303",
    "split-line",
    "error",
    what="A line of `split.txt` does not have a name and a period.",
    remedy='write "<image name> <period id>"',
    bad="`a.jpg`",
    needs=("split",),
)
def split_line(scene: RawScene) -> Iterator[Hit]:
    return problem_hits(SPLIT, scene.split_problems, "fields")


@rule(
    "CS304",
    "split-period",
    "error",
    what="The last field of a line of `split.txt` is not a period id.",
    remedy="write a whole number 0, 1, ... at the end of the line",
    bad="`a.jpg 2016-05`",
    needs=("split",),
)
def split_period(scene: RawScene) -> Iterator[Hit]:
    return problem_hits(SPLIT, scene.split_problems, "period")


@rule(
    "CS305",
    "image-without-period",
    "error",
    what="A registered image is not in `split.txt`.",
    remedy="add a line for it, or correct the name in its line",
    bad="`images.bin` has `a.jpg`, `split.txt` does not name it",
    needs=("images", "split"),
)
def image_without_period(scene: RawScene) -> Iterator[Hit]:
    reported = in_other_words(scene)
    entries = {entry.line: entry for entry in scene.split or ()}
    misspelt = {name: entries[line] for line, name in meant_in_split(scene).items()}
    for name in scene.names:
        if scene.periods is not None and name not in scene.periods and name not in reported:
            found, entry = "none that names it", misspelt.get(name)
            if entry is not None:
                found += f"; line {entry.line} names {quote(entry.name)}"
            yield Hit(scene.image_place(name), f"a line in {SPLIT}", found)


@rule(
    "CS306",
    "split-ambiguous",
    "error",
    what="A name in `split.txt` fits several images.",
    remedy="write the full names below images/",
    bad="`0001 0` with `x/0001.png` and `y/0001.png` in the model",
    needs=("images", "split"),
)
def split_ambiguous(scene: RawScene) -> Iterator[Hit]:
    return problem_hits(SPLIT, scene.split_problems, "ambiguous")


@rule(
    "CS307",
    "split-contradiction",
    "error",
    what="`split.txt` gives an image two periods.",
    remedy="keep one of the two lines",
    bad="`a.jpg 0` and, further down, `a.jpg 1`",
    needs=("images", "split"),
)
def split_contradiction(scene: RawScene) -> Iterator[Hit]:
    return problem_hits(SPLIT, scene.split_problems, "contradiction")


@rule(
    "CS308",
    "split-duplicate",
    "info",
    what="`split.txt` lists an image twice, with the same period.",
    remedy="delete one of the lines",
    bad="`a.jpg 0` twice",
    needs=("images", "split"),
)
def split_duplicate(scene: RawScene) -> Iterator[Hit]:
    return problem_hits(SPLIT, scene.split_problems, "duplicate")


@rule(
    "CS309",
    "split-unknown",
    "warning",
    what="`split.txt` names an image that is not in the model; the line has no effect.",
    remedy="correct the name, or delete the line if the image could not be registered",
    bad="`IMG_1.jpg 0`, the image is `IMG_0001.jpg`",
    needs=("images", "split"),
)
def split_unknown(scene: RawScene) -> Iterator[Hit]:
    images, known = meant_in_split(scene), set(scene.period_ids)
    period = {entry.line: entry.period for entry in scene.split or ()}
    periods = scene.periods or {}
    worth = [
        p
        for p in scene.split_problems
        # That a period or an image has nothing at all is one finding: an error of its own.
        if (images[p.line] in periods if p.line in images else period.get(p.line or 0) in known)
    ]
    yield from unknown_hits(SPLIT, worth, images)


@rule(
    "CS310",
    "split-line-ends",
    "info",
    what="Lines of `split.txt` end as in Windows; tools that cut at blanks read a carriage return "
    "as part of the period.",
    remedy="nothing to do here; save it with Unix line ends for other tools",
    bad="`a.jpg 0` with `\\r\\n` behind it",
    needs=("split_text",),
)
def split_line_ends(scene: RawScene) -> Iterator[Hit]:
    assert scene.split_text is not None
    if lines := scene.split_text.text.count("\r"):
        found = f"carriage returns in {counted(lines, 'line')}"
        yield Hit(SPLIT, "Unix line ends", found, count=lines)
