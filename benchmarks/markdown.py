"""Tables in Markdown, the growth in them, and their places on pages."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path


def table(head: Sequence[str], rows: Iterable[Iterable[str]], *, numbers: bool = True) -> str:
    """Format a table; ``numbers``: columns after the first are aligned on the right."""
    rule = ["---", *["---:" if numbers else "---"] * (len(head) - 1)]
    return "\n".join(f"| {' | '.join(line)} |" for line in (head, rule, *rows))


def exponents(
    values: Sequence[float | None], sizes: Sequence[int], least: float = 0.0
) -> list[str]:
    """Power of the size with which each value grows; - where one is not above ``least``."""
    return [
        f"{math.log(b / a) / math.log(n / m):.2f}" if a and b and min(a, b) > least else "-"
        for (a, b), (m, n) in zip(pairwise(values), pairwise(sizes), strict=True)
    ]


def replace_part(page: Path, name: str, text: str) -> None:
    """Write a text between the comments ``NAME: begin`` and ``NAME: end`` of a page."""
    begin, end = (f"<!-- {name}: {place} -->" for place in ("begin", "end"))
    before, rest = page.read_text("utf-8").split(begin)
    page.write_text(f"{before}{begin}\n{text}{end}{rest.split(end)[1]}", "utf-8")
