"""Docstrings open with a verb or a noun phrase, and nothing speaks a private vocabulary."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PACKAGES = ("chronoscene", "chronogs", "baselines", "leaderboard")

OPENING = re.compile(r"\s*(What|Whether|Where|How|Of|Those|Which|When|Who|Why|That|As|If)\b")
"""Words that open a subordinate clause, not a sentence or a noun phrase."""

PRIVATE_WORDS = re.compile(r"\bSay\b|\btold\b|\btells\b|\bthis room\b|\brooms\b")
"""Names and words that the code does without: `Log`; reported, warned; package."""


def sources() -> Iterator[tuple[str, str]]:
    """Path within the repository and text of each module."""
    for package in PACKAGES:
        for path in sorted((ROOT / package).rglob("*.py")):
            yield path.relative_to(ROOT).as_posix(), path.read_text(encoding="utf-8")


def docstrings(text: str) -> Iterator[tuple[int, str]]:
    """Line and text of docstrings, and of the strings under fields and constants."""
    for node in ast.walk(ast.parse(text)):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        owner = isinstance(node, (ast.Module, ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef))
        for before, statement in zip([None, *body], body, strict=False):
            documents = isinstance(before, (ast.Assign, ast.AnnAssign)) or (owner and not before)
            if (
                documents
                and isinstance(statement, ast.Expr)
                and isinstance(statement.value, ast.Constant)
                and isinstance(statement.value.value, str)
            ):
                yield statement.lineno, statement.value.value


def test_docstrings_open_with_a_verb_or_a_noun() -> None:
    assert not [
        f"{path}:{line}: {doc[:60]!r}"
        for path, text in sources()
        for line, doc in docstrings(text)
        if OPENING.match(doc)
    ]


def test_no_private_vocabulary() -> None:
    assert not [
        f"{path}:{number}: {line.strip()[:80]}"
        for path, text in sources()
        for number, line in enumerate(text.splitlines(), 1)
        if PRIVATE_WORDS.search(line)
    ]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ('"""Whether it is."""', 1),
        ('def f():\n    """\n    How it goes."""', 1),
        ('class C:\n    """A class."""\n\n    x: int = 0\n    """Of which."""', 1),
        ('"""Whereabouts of a thing."""', 0),
        ('def f():\n    print("x")\n    "What else"', 0),
    ],
)
def test_lint_itself(text: str, found: int) -> None:
    assert sum(bool(OPENING.match(doc)) for _, doc in docstrings(text)) == found
