"""Period table (``split.txt``), test list (``test.txt``) and the default split.

The parsers return what they could read and a list of problems: readers raise the first one, and the
validator reports them all.
"""

from __future__ import annotations

import hashlib
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Literal

from chronoscene.errors import SceneError
from chronoscene.scene import Scene, Split
from chronoscene.scene.grouping import grouped

SPLIT = "sparse/split.txt"  # Place of the period table in a scene folder

TEST_EVERY = 8  # The default split takes the images 0, 8, 16, ... of each period for testing.

DEFAULT_RULE = "every 8th image of each period in name order (index 0, 8, ...)"

IMAGE_SUFFIXES = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp")
"""Extensions that are removed when names are compared without them."""

ProblemKind = Literal[
    "fields",  # a line without two fields
    "period",  # a period id that is not a number 0, 1, ...
    "ambiguous",  # a name that matches several images
    "contradiction",  # an image with two different periods
    "duplicate",  # an image listed twice, with the same period
    "unknown",  # a name that matches no registered image
    "missing",  # a registered image without a period
    "ids",  # period ids that are not 0..T-1
    "empty",  # a period without any registered image
]

FATAL: frozenset[ProblemKind] = frozenset(
    {"fields", "period", "ambiguous", "contradiction", "missing", "ids", "empty"}
)
"""Kinds that make a scene unreadable; the others are only reported."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One problem of a file."""

    kind: ProblemKind
    line: int | None
    """Line number from 1; None for the whole file."""
    expected: str
    found: str
    todo: str = "see DATASET.md"

    def error(self, path: Path) -> SceneError:
        """The problem as an exception that names the file."""
        place = str(path) if self.line is None else f"{path}:{self.line}"
        return SceneError(place, expected=self.expected, found=self.found, todo=self.todo)


@dataclass(frozen=True, slots=True)
class SplitEntry:
    """One line of ``split.txt``: an image, by any form of its name, and its period."""

    line: int
    name: str
    period: int


@dataclass(frozen=True, slots=True)
class NameEntry:
    """One line of ``test.txt``."""

    line: int
    name: str


def parse_split_text(text: str) -> tuple[list[SplitEntry], list[Problem]]:
    """Parse ``<image name> <period id>`` lines.

    The last field is the period and all before it the name, so names may contain blanks. Fields
    are separated by blanks or tabs, also repeated ones; empty lines are skipped.
    """
    entries, problems = [], []
    for number, line in _lines(text):
        fields = line.rsplit(maxsplit=1)
        if len(fields) < 2:
            expected = '"<image name> <period id>"'
            problems.append(Problem("fields", number, expected, f"one field: {line!r}"))
        elif not re.fullmatch("[0-9]{1,9}", fields[1]):
            expected = "a period id 0, 1, ... as the last field"
            problems.append(Problem("period", number, expected, repr(line)))
        else:
            entries.append(SplitEntry(number, fields[0].strip(), int(fields[1])))
    return entries, problems


def format_split_text(periods: Mapping[str, int]) -> str:
    """Inverse of `parse_split_text` for names without leading or trailing blanks."""
    return "".join(f"{name} {period}\n" for name, period in periods.items())


def parse_test_text(text: str) -> list[NameEntry]:
    """Parse ``test.txt``: one name a line, empty lines skipped. Every line is a name."""
    return [NameEntry(number, line) for number, line in _lines(text)]


def _lines(text: str) -> Iterable[tuple[int, str]]:
    """Non-empty lines without surrounding blanks, numbered from 1."""
    for number, line in enumerate(re.split("\r\n|\r|\n", text), start=1):
        if stripped := line.strip():
            yield number, stripped


def composed(name: str) -> str:
    """Return a name with accented letters as single characters, in which names are compared.

    Files from macOS have them as a letter and an accent, which look the same.
    """
    return unicodedata.normalize("NFC", name)


class NameIndex:
    """Finds images by full name, file name, or file name without extension.

    The forms are tried in this order, and the first that matches any image decides:

    1. the full name below ``images/``;
    2. the file name, without folders;
    3. either of these without extension;
    4. the file name up to its first dot, which is how the official loader identifies images.

    Folders of an entry count, unless no image is in a folder.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self._flat = not any("/" in name for name in self.names)
        self._levels: tuple[dict[str, list[str]], ...] = ({}, {}, {}, {})
        for name in self.names:
            for level, keys in zip(self._levels, _image_keys(name), strict=True):
                for key in keys:
                    level.setdefault(key, []).append(name)

    def find(self, entry: str) -> list[str]:
        """Images that an entry matches: exactly one if the entry is valid."""
        entry = entry.removeprefix("./")
        if self._flat:
            entry = PurePosixPath(entry).name
        for level, key in zip(self._levels, _entry_keys(entry), strict=True):
            if key is not None and key in level:
                return level[key]
        return []


def _image_keys(name: str) -> tuple[set[str], ...]:
    """Keys of an image on each level."""
    folder, slash, file = name.rpartition("/")  # ten times as fast as pathlib
    dot = file.rfind(".")
    stem = file[:dot] if 0 < dot < len(file) - 1 else file
    first = file.split(".")[0]
    above = folder + slash
    return {name}, {file}, {above + stem, stem}, {above + first, first}


def _entry_keys(entry: str) -> tuple[str | None, ...]:
    """Key of an entry on each level; None where the level does not apply.

    Only known extensions are removed, so ``a.1`` never becomes ``a``. On the last level, an entry
    that still has a dot names another image.
    """
    suffix = PurePosixPath(entry).suffix
    bare = entry[: -len(suffix)] if suffix.lower() in IMAGE_SUFFIXES else entry
    return entry, entry, bare, None if "." in PurePosixPath(bare).name else bare


def assign_periods(
    names: Sequence[str], entries: Sequence[SplitEntry]
) -> tuple[dict[str, int], list[Problem]]:
    """Assign a period to each registered image.

    Args:
        names: Full names of all registered images.
        entries: The parsed ``split.txt``.

    Returns:
        Period by full name, for the images that have exactly one; and every problem.
    """
    index = NameIndex(names)
    periods: dict[str, int] = {}
    lines: dict[str, int] = {}
    placed = [_place(entry, index.find(entry.name), periods, lines) for entry in entries]
    problems = [problem for problem in placed if problem is not None]
    problems += [
        Problem(
            "missing",
            None,
            f"a period for every registered image, {name!r} too",
            "none",
            "add a line for it",
        )
        for name in names
        if name not in periods
    ]
    return periods, problems + check_period_ids(entries, periods.values())


def _place(
    entry: SplitEntry, found: list[str], periods: dict[str, int], lines: dict[str, int]
) -> Problem | None:
    """Add one entry to ``periods``, or return why that is impossible."""
    if len(found) != 1:
        return _not_one(entry, found)
    (name,) = found
    if name not in periods:
        periods[name], lines[name] = entry.period, entry.line
        return None
    if periods[name] != entry.period:
        expected = f"period {periods[name]} for {name!r} as in line {lines[name]}"
        found_period = f"period {entry.period}"
        todo = "keep one of the two lines"
        return Problem("contradiction", entry.line, expected, found_period, todo)
    return Problem("duplicate", entry.line, "each image once", f"{name!r} as in line {lines[name]}")


def _not_one(entry: SplitEntry | NameEntry, found: list[str]) -> Problem:
    """The problem of a name that matches no image, or several."""
    if not found:
        return Problem("unknown", entry.line, "the name of a registered image", repr(entry.name))
    several = f"{entry.name!r}, which matches {', '.join(map(repr, found[:3]))}"
    todo = "write the full names below images/"
    return Problem("ambiguous", entry.line, "a name that matches one image", several, todo)


def check_period_ids(entries: Iterable[SplitEntry], used: Iterable[int]) -> list[Problem]:
    """Check that the ids are 0..T-1 and that every period has a registered image."""
    ids, used = sorted({entry.period for entry in entries}), set(used)
    if not ids:
        return [Problem("ids", None, "at least one line", "none")]
    if ids != list(range(len(ids))):
        shown = ", ".join(map(str, ids[:10])) + (", ..." if len(ids) > 10 else "")
        expected = f"period ids 0..{len(ids) - 1} for {len(ids)} periods"
        return [Problem("ids", None, expected, shown, "number the periods from 0 without gaps")]
    todo = "register images of this period, or renumber the others"
    return [
        Problem("empty", None, f"a registered image of period {i}", "none", todo)
        for i in ids
        if i not in used
    ]


def assign_tests(
    names: Sequence[str], entries: Sequence[NameEntry]
) -> tuple[set[str], list[Problem]]:
    """Full names of the test images that ``test.txt`` lists, and every problem."""
    index = NameIndex(names)
    tests: set[str] = set()
    problems = []
    for entry in entries:
        found = index.find(entry.name)
        if len(found) == 1:
            tests.add(found[0])
        else:
            problems.append(_not_one(entry, found))
    return tests, problems


def default_tests(periods: Mapping[str, int]) -> set[str]:
    """The default split: every 8th image of each period in name order, from the first on."""
    by_period = grouped((periods[name], name) for name in sorted(periods))
    return {name for names in by_period.values() for name in names[::TEST_EVERY]}


def split_hash(scene: Scene) -> str:
    """Fingerprint of the split: SHA-256 over the sorted lines ``name TAB period TAB split``."""
    lines = sorted(f"{f.name}\t{f.period}\t{f.split}\n" for f in scene.frames)
    return hashlib.sha256("".join(lines).encode()).hexdigest()


def split_of(name: str, tests: set[str]) -> Split:
    """``test`` for the names in ``tests``, else ``train``."""
    return "test" if name in tests else "train"
