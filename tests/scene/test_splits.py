"""Period tables, test lists, name matching, the default split and its fingerprint."""

import hashlib
from dataclasses import replace
from pathlib import PurePosixPath

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.formats import read_scene
from chronoscene.scene.splits import (
    FATAL,
    NameEntry,
    NameIndex,
    SplitEntry,
    _image_keys,
    assign_periods,
    assign_tests,
    default_tests,
    format_split_text,
    parse_split_text,
    parse_test_text,
    split_hash,
)

texts = st.text(st.characters(exclude_categories=("Cs", "Cc")), min_size=1, max_size=12)
line_names = texts.map(str.strip).filter(bool)
"""Anything that fits on a line, without blanks at its ends."""

folders = st.sampled_from(["", "a/", "b/", "a/b/"])
bases = st.from_regex(r"[ab1][ab1. ]{0,3}", fullmatch=True)
suffixes = st.sampled_from(["", ".png", ".PNG", ".jpg", ".tif"])
file_names = st.builds("".join, st.tuples(folders, bases, suffixes))


def entries(*lines: tuple[str, int]) -> list[SplitEntry]:
    return [SplitEntry(i, name, period) for i, (name, period) in enumerate(lines, start=1)]


def kinds(problems) -> list[tuple[str, int | None]]:
    return [(p.kind, p.line) for p in problems]


@given(st.dictionaries(line_names, st.integers(0, 999)))
def test_split_text_round_trip(periods):
    parsed, problems = parse_split_text(format_split_text(periods))
    assert {e.name: e.period for e in parsed} == periods
    assert problems == []


@given(st.lists(line_names), st.sampled_from(["\n", "\r\n", "\r"]), st.sampled_from(["", "\n\n"]))
def test_test_text_round_trip(names, end, tail):
    text = end.join(names) + tail
    assert [e.name for e in parse_test_text(text)] == names


@given(st.text())
def test_any_text_gives_entries_or_problems_for_every_line(text):
    parsed, problems = parse_split_text(text)
    lines = {e.line for e in parsed} | {p.line for p in problems}
    assert len(lines) == len(parsed) + len(problems)
    assert len(lines) == len(parse_test_text(text))
    assert all(e.period >= 0 and e.name for e in parsed)


def test_every_bad_line_is_reported():
    parsed, problems = parse_split_text("a 0\n\nb\nc x\nd 1.0\ne -1\nf \u0661\ng 1\n")
    assert [(e.line, e.name, e.period) for e in parsed] == [(1, "a", 0), (8, "g", 1)]
    assert kinds(problems) == [("fields", 3), *(("period", i) for i in (4, 5, 6, 7))]


@given(st.lists(file_names, unique=True, min_size=1, max_size=8))
def test_the_full_name_always_finds_its_image(names):
    index = NameIndex(names)
    flat = not any("/" in name for name in names)
    for name in names:
        assert index.find(name) == [name]
        assert index.find(f"./{name}") == [name]
        if flat:
            assert index.find(f"some/folder/{name}") == [name]


@given(st.lists(file_names, unique=True, min_size=1, max_size=8), file_names)
def test_a_match_agrees_with_the_identity_of_the_official_loader(names, entry):
    """Whatever we match, the name up to its first dot is the same; folders never contradict."""
    for found in NameIndex(names).find(entry):
        assert found.split("/")[-1].split(".")[0] == entry.split("/")[-1].split(".")[0]
        if "/" in entry and any("/" in n for n in names):
            assert found.rsplit("/", 1)[:-1] == entry.rsplit("/", 1)[:-1]


@pytest.mark.parametrize(
    ("names", "entry", "found"),
    [
        (["x/0001.png"], "0001.png", ["x/0001.png"]),
        (["x/0001.png"], "0001", ["x/0001.png"]),
        (["x/0001.png"], "x/0001", ["x/0001.png"]),
        (["x/0001.png"], "y/0001", []),
        (["0001.png"], "y/0001", ["0001.png"]),
        (["0001.jpg"], "0001.png", ["0001.jpg"]),
        (["0001.jpg"], "0001.JPG", ["0001.jpg"]),
        (["x/0001.JPG"], "x/0001.jpg", ["x/0001.JPG"]),
        (["0001.jpg", "0001.JPG"], "0001.JPG", ["0001.JPG"]),
        (["0001.jpg", "0001.png"], "0001.png", ["0001.png"]),
        (["0001.jpg", "0001.png"], "0001", ["0001.jpg", "0001.png"]),
        (["a.1.png", "a.2.png"], "a.1", ["a.1.png"]),
        (["a.1.png", "a.2.png"], "a", ["a.1.png", "a.2.png"]),
        (["a.2.png"], "a.1", []),
        (["a.2.png"], "a.1.png", []),
        (["a.2.png"], "a", ["a.2.png"]),
        (["a.2.png"], "a.jpg", ["a.2.png"]),
        (["a", "b/a.png"], "a", ["a"]),
        (["x/1.png", "y/1.png", "1.png"], "1.png", ["1.png"]),
    ],
)
def test_matching(names, entry, found):
    assert NameIndex(names).find(entry) == found


def test_assign_reports_everything_at_once():
    names = ["x/1.png", "y/1.png", "2.png", "3.png"]
    lines = entries(("x/1", 0), ("1", 1), ("2", 0), ("2.png", 1), ("x/1.png", 0), ("lost", 1))
    periods, problems = assign_periods(names, lines)
    assert periods == {"x/1.png": 0, "2.png": 0}
    assert kinds(problems) == [
        ("ambiguous", 2),
        ("contradiction", 4),
        ("duplicate", 5),
        ("unknown", 6),
        ("missing", None),
        ("missing", None),
        ("empty", None),
    ]
    assert {"duplicate", "unknown"}.isdisjoint(FATAL)


@given(st.lists(st.integers(0, 6), min_size=1, max_size=12))
def test_period_ids_are_checked(ids):
    names = [f"{i:02d}.png" for i in range(len(ids))]
    periods, problems = assign_periods(names, entries(*zip(names, ids, strict=True)))
    assert list(periods.values()) == ids
    gapless = set(ids) == set(range(max(ids) + 1))
    assert kinds(problems) == ([] if gapless else [("ids", None)])


def test_assign_tests():
    names = ["x/1.png", "y/1.png", "2.png"]
    listed = [NameEntry(i, n) for i, n in enumerate(["2", "1", "lost", "y/1"], start=1)]
    tests, problems = assign_tests(names, listed)
    assert tests == {"2.png", "y/1.png"}
    assert kinds(problems) == [("ambiguous", 2), ("unknown", 3)]


@given(st.dictionaries(file_names, st.integers(0, 3), min_size=1, max_size=60))
def test_default_split_serves_every_period(periods):
    tests = default_tests(periods)
    for period in set(periods.values()):
        names = sorted(n for n in periods if periods[n] == period)
        assert [i for i, n in enumerate(names) if n in tests] == list(range(0, len(names), 8))


def test_split_hash(make_scene_folder):
    scene = read_scene(make_scene_folder({"a.png": 0, "b.png": 1}, tests=["b"]))
    expected = hashlib.sha256(b"a.png\t0\ttrain\nb.png\t1\ttest\n").hexdigest()
    assert split_hash(scene) == expected
    other = scene.with_frames([replace(f, split="train") for f in scene.frames])
    assert split_hash(other) != expected


PART = st.text("ab.é 1", min_size=1, max_size=6).filter(lambda part: part.strip("."))


@given(st.lists(PART, min_size=1, max_size=3).map("/".join))
def test_forms_of_a_name_are_those_of_pathlib(name):
    path = PurePosixPath(name)
    first = path.name.split(".")[0]
    full, file, bare, cut = _image_keys(name)
    assert (full, file) == ({name}, {path.name})
    assert bare == {str(path.with_suffix("")), path.stem}
    assert cut == ({f"{path.parent}/{first}", first} if "/" in name else {first})
