"""Tables as text, Markdown and LaTeX; names are only text in each of them."""

from __future__ import annotations

import io
import re
from collections.abc import Collection, Sequence
from typing import TYPE_CHECKING

from chronoscene.io.wording import printable

if TYPE_CHECKING:
    from rich.table import Table

Head = tuple[str, str]
"""Two lines; a column whose first line is empty belongs to the one before."""
GAP = 2
"""Blanks between columns."""
LEAST_NAME = 12
"""Characters of a name that are shown on narrow terminals."""


def text_table(
    heads: Sequence[Head],
    lines: Sequence[Sequence[str]],
    *,
    named: int,
    ends: Collection[int],
    width: int | None = None,
) -> str:
    """A table for a terminal, without colours.

    Args:
        heads: Of the columns.
        lines: Cells of the rows.
        named: Number of first columns, which say what a row is about.
        ends: Rows after which there is a gap.
        width: Of the terminal in characters; a wider table is cut into blocks, which all have the
            first columns. None for one block.
    """
    from rich.cells import cell_len

    lines = [[printable(cell) for cell in line] for line in lines]
    texts = [[*heads[i], *(line[i] for line in lines)] for i in range(len(heads))]
    sizes = [GAP + max(map(cell_len, column)) for column in texts]
    if width is None or 1 + sum(sizes) <= width:
        return plain_text(_block(heads, lines, range(len(heads)), named, ends))
    longest = max(LEAST_NAME, width // 5)
    sizes = [min(size, GAP + longest) if i < named else size for i, size in enumerate(sizes)]
    blocks = _fitting(heads, sizes, named, width)
    return "".join(plain_text(_block(heads, lines, b, named, ends, longest)) for b in blocks)


def _fitting(
    heads: Sequence[Head], sizes: Sequence[int], named: int, width: int
) -> list[list[int]]:
    """Columns of each block."""
    first, rest = range(named), range(named, len(heads))
    groups: list[list[int]] = []
    for i in rest:
        if groups and not heads[i][0]:
            groups[-1].append(i)
        else:
            groups.append([i])
    blocks = [list(first)]
    for group in groups:
        taken = 1 + sum(sizes[i] for i in (*blocks[-1], *group))
        if taken > width and len(blocks[-1]) > named:
            blocks.append(list(first))
        blocks[-1] += group
    return blocks


def _block(
    heads: Sequence[Head],
    lines: Sequence[Sequence[str]],
    columns: Sequence[int],
    named: int,
    ends: Collection[int],
    longest: int | None = None,
) -> Table:
    """Some columns of a table; of the first, what is longer is cut."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, padding=(0, GAP - 1, 0, 0), collapse_padding=True)
    for i in columns:
        head = "\n".join(heads[i])
        if i < named:
            table.add_column(head, no_wrap=True, max_width=longest, overflow="ellipsis")
        else:
            table.add_column(head, no_wrap=True, justify="right")
    for row, line in enumerate(lines):
        table.add_row(*(line[i] for i in columns), end_section=row in ends)
    return table


def plain_text(table: Table) -> str:
    """A table as text, as wide as it is; markup in its cells is only text."""
    from rich.console import Console

    out = io.StringIO()
    console = Console(file=out, width=10_000, color_system=None, markup=False, emoji=False)
    console.print(table)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def markdown_table(heads: Sequence[str], lines: Sequence[Sequence[str]], *, named: int) -> str:
    """A pipe table; the first columns are on the left."""
    rule = ["---"] * named + ["---:"] * (len(heads) - named)
    rows = [heads, rule, *([_markdown(cell) for cell in line] for line in lines)]
    return "".join(f"| {' | '.join(row)} |\n" for row in rows)


def _markdown(text: str) -> str:
    return re.sub(r"([\\`*<>|\[\]])", r"\\\1", printable(text))


_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
    }
)


def escape_latex(text: str) -> str:
    """Text as LaTeX prints it."""
    return printable(text).translate(_LATEX)


def latex_heads(heads: Sequence[Head]) -> list[str]:
    """Two rows of heads; what belongs to several columns stands above all of them."""
    starts = [i for i, head in enumerate(heads) if head[0] or i == 0]
    spans = [end - start for start, end in zip(starts, [*starts[1:], len(heads)], strict=True)]
    first = []
    for start, span in zip(starts, spans, strict=True):
        text = escape_latex(heads[start][0])
        first.append(text if span == 1 else rf"\multicolumn{{{span}}}{{c}}{{{text}}}")
    second = [escape_latex(head[1]) for head in heads]
    return [f"{' & '.join(row)} \\\\" for row in (first, second)]


def latex_row(cells: Sequence[str]) -> str:
    """A row of a ``tabular``; the cells are text."""
    row = " & ".join(map(escape_latex, cells)) + r" \\"
    # After the end of the row before, a bracket or a star would be an option of it.
    return "{}" + row if row.startswith(("[", "*")) else row
