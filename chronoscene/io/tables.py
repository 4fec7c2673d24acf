"""Tables as text for a terminal, Markdown, LaTeX and CSV; names are only text in each of them.

A `Table` holds cells as they are read. It does not need pandas: importing pandas takes half as long
as ``chronoscene stats`` on a scene, so only the tables of runs (`chronoscene.harness.report`) group
and average with it.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from chronoscene.io.wording import printable

FORMATS = ("table", "csv", "markdown", "latex", "json")
"""Formats of tables; ``table`` is text for a terminal."""

Head = str | tuple[str, str]
"""One line, or two; a column whose first line is empty shares that of the column before."""
LEGENDS = {
    "table": "¹, ², ³: the first three of a column",
    "markdown": "**bold**, <ins>underlined</ins>, *italic*: the first three of a column",
    "latex": "bold, underlined, italic: the first three of a column",
}
"""Descriptions of the marks of `Table.ranks`; those of `Table.ties` are daggers."""
_RANKS = {
    "table": ("{}", "¹ {}", "² {}", "³ {}"),
    "markdown": ("{}", "**{}**", "<ins>{}</ins>", "*{}*"),
    "latex": ("{}", r"\textbf{{{}}}", r"\underline{{{}}}", r"\textit{{{}}}"),
}
# Numbers stay aligned on the right.
_TIES = {"table": "†{}", "markdown": "{} †", "latex": r"{}\rlap{{$^\dagger$}}"}

_NEGATIVE = re.compile(r"(?<![\w.-])-(?=\d)")  # No hyphen, as in dates and ranges
GAP = 2  # Blanks between columns
MIN_NAME_WIDTH = 12  # Characters of a name that are shown even on narrow terminals


@dataclass(frozen=True, slots=True)
class Table:
    """Cells as they are read, with heads and marks."""

    heads: Sequence[Head]
    """One per column."""
    rows: Sequence[Sequence[str]]
    labels: int = 1
    """Number of leading columns that say what a row is about; they are aligned on the left."""
    title: str = ""
    ranks: Mapping[tuple[int, int], int] = field(default_factory=dict)
    """Row and column of the cells that are the first, second or third of their column."""
    ties: Collection[tuple[int, int]] = ()
    """Row and column of the cells that the first of their column may not really be better than."""
    breaks: Collection[int] = ()
    """Rows that are followed by a rule or a gap."""

    @property
    def head_lines(self) -> list[tuple[str, str]]:
        """Both lines of each head."""
        return [(head, "") if isinstance(head, str) else head for head in self.heads]

    @property
    def flat_heads(self) -> list[str]:
        """Heads on one line, each complete in itself."""
        flat, first = [], ""
        for above, below in self.head_lines:
            first = above or first
            flat.append(" ".join(filter(None, (first, below))))
        return flat


def _marked(table: Table, i: int, j: int, cell: str, style: str) -> str:
    ranked = _RANKS[style][table.ranks.get((i, j), 0)].format(cell)
    return _TIES[style].format(ranked) if (i, j) in table.ties else ranked


def csv_text(columns: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    """Format a CSV document with a header; None becomes an empty cell."""
    buffer = io.StringIO()
    writer = csv.writer(buffer, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(rows)
    return buffer.getvalue()


def plain_text(table: Table) -> str:
    """Format title and aligned columns, without marks."""
    lines = [table.flat_heads, *table.rows]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    aligned = (
        "  ".join(
            cell.ljust(width) if j < table.labels else cell.rjust(width)
            for j, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for line in lines
    )
    return "\n".join([table.title, *aligned]) + "\n"


def boxed_text(table: Table, *, width: int | None = None) -> str:
    """Format a table with rules for a terminal, without colours.

    Args:
        table: What to write.
        width: Of the terminal in characters. A wider table is cut into blocks of columns, each with
            the labels of the rows, which go over several lines where that saves a block. None for
            one block.
    """
    from rich.cells import cell_len

    title = f"{printable(table.title)}\n" if table.title else ""
    rows = [
        [_marked(table, i, j, printable(cell), "table") for j, cell in enumerate(row)]
        for i, row in enumerate(table.rows)
    ]
    heads = [(printable(first), printable(second)) for first, second in table.head_lines]
    table = replace(table, heads=heads)
    columns = zip(*(zip(*heads, strict=True)), *rows, strict=True)
    sizes = [GAP + max(map(cell_len, column)) for column in columns]
    if width is None or 1 + sum(sizes) <= width:
        return title + _block(table, rows, range(len(sizes)))
    labels, others = sizes[: table.labels], sizes[table.labels :]
    least = max(MIN_NAME_WIDTH, width // 5)
    cuts = []
    for longest in range(max(least, *labels), least - 1, -1):
        sizes = [*(min(size, GAP + longest) for size in labels), *others]
        blocks = _fitting(table, sizes, width)
        excess = max(0, *(1 + sum(sizes[i] for i in block) - width for block in blocks))
        cuts.append((excess, len(blocks), longest, blocks))
    *_, longest, blocks = min(cuts, key=lambda cut: cut[:2])
    return title + "".join(_block(table, rows, block, longest) for block in blocks)


def _fitting(table: Table, sizes: Sequence[int], width: int) -> list[list[int]]:
    """Divide columns into blocks; those with a common head stay together."""
    groups: list[list[int]] = []
    for i in range(table.labels, len(sizes)):
        if groups and not table.head_lines[i][0]:
            groups[-1].append(i)
        else:
            groups.append([i])
    blocks = [list(range(table.labels))]
    for group in groups:
        taken = 1 + sum(sizes[i] for i in (*blocks[-1], *group))
        if taken > width and len(blocks[-1]) > table.labels:
            blocks.append(list(range(table.labels)))
        blocks[-1] += group
    return blocks


def _block(
    table: Table, rows: Sequence[Sequence[str]], columns: Sequence[int], longest: int | None = None
) -> str:
    """Some columns of a table; labels longer than ``longest`` go over several lines, words that are
    longer are cut. Markup is only text."""
    from rich import box
    from rich.console import Console
    from rich.table import Table as RichTable

    heads = table.head_lines
    two_lines = any(heads[i][1] for i in columns)
    drawn = RichTable(box=box.SIMPLE_HEAD, padding=(0, GAP - 1, 0, 0), collapse_padding=True)
    for i in columns:
        head = "\n".join(heads[i] if two_lines else heads[i][:1])
        if i < table.labels:
            drawn.add_column(head, max_width=longest, overflow="ellipsis")
        else:
            drawn.add_column(head, no_wrap=True, justify="right")
    for number, row in enumerate(rows):
        drawn.add_row(*(row[i] for i in columns), end_section=number in table.breaks)
    out = io.StringIO()
    console = Console(file=out, width=10_000, color_system=None, markup=False, emoji=False)
    console.print(drawn)
    return "\n".join(line.rstrip() for line in out.getvalue().splitlines()) + "\n"


def markdown(table: Table, *, special: str = r"\`*<>|[]") -> str:
    """Format a pipe table, under its title if it has one.

    Args:
        table: What to write.
        special: Characters that are escaped in cells.
    """
    lines = []
    if table.title:
        lines += [f"**{escape_markdown(printable(table.title))}**", ""]
    lines.append(_piped([escape_markdown(printable(head)) for head in table.flat_heads]))
    rule = ["---"] * table.labels + ["---:"] * (len(table.heads) - table.labels)
    lines.append(_piped(rule))
    for i, row in enumerate(table.rows):
        cells = [escape_markdown(printable(cell), special) for cell in row]
        lines.append(_piped([_marked(table, i, j, c, "markdown") for j, c in enumerate(cells)]))
    return "\n".join(lines) + "\n"


def markdown_list(lines: Iterable[str]) -> str:
    """Format plain lines as a list, in which nothing of them is markup."""
    texts = (escape_markdown(printable(line), special=r"\`*<>_[") for line in lines)
    return "".join(f"- {text}\n" for text in texts)


def _piped(cells: Sequence[str]) -> str:
    return f"| {' | '.join(cells)} |"


def escape_markdown(text: str, special: str = r"\`*<>|_") -> str:
    """Put a backslash before each special character."""
    return re.sub(f"([{re.escape(special)}])", r"\\\1", text)


def latex(table: Table, *, cmidrules: bool = False) -> str:
    """Format a ``tabular`` for the booktabs package, its title in a comment.

    Args:
        table: What to write.
        cmidrules: Whether to draw rules under heads of several columns.
    """
    lines = [f"% {printable(table.title)}"] if table.title else []
    lines += [
        rf"\begin{{tabular}}{{{'l' * table.labels}{'r' * (len(table.heads) - table.labels)}}}",
        r"\toprule",
        *_latex_heads(table.head_lines, cmidrules),
        r"\midrule",
    ]
    for i, row in enumerate(table.rows):
        numbers = [_NEGATIVE.sub("\N{MINUS SIGN}", cell) for cell in row[table.labels :]]
        cells = [escape_latex(cell) for cell in (*row[: table.labels], *numbers)]
        lines.append(_latex_row(_marked(table, i, j, c, "latex") for j, c in enumerate(cells)))
        if i in table.breaks:
            lines.append(r"\midrule")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}", ""])


def _latex_heads(heads: Sequence[tuple[str, str]], cmidrules: bool) -> list[str]:
    """Format one row of heads, or two, where common heads of several columns stand above them."""
    if not any(second for _, second in heads):
        return [_latex_row([escape_latex(first) for first, _ in heads])]
    starts = [i for i, head in enumerate(heads) if head[0] or i == 0]
    first, rules = [], ""
    for start, end in zip(starts, [*starts[1:], len(heads)], strict=True):
        text = escape_latex(heads[start][0])
        first.append(text if end - start == 1 else rf"\multicolumn{{{end - start}}}{{c}}{{{text}}}")
        rules += rf"\cmidrule(lr){{{start + 1}-{end}}}" if end - start > 1 else ""
    second = _latex_row([escape_latex(text) for _, text in heads])
    return [_latex_row(first), *([rules] if cmidrules and rules else []), second]


def _latex_row(cells: Iterable[str]) -> str:
    row = " & ".join(cells) + r" \\"
    # After the end of the row before, a bracket or a star would be an option of it.
    return "{}" + row if row.startswith(("[", "*")) else row


def text_of(table: Table, style: str, *, width: int | None = None, cmidrules: bool = False) -> str:
    """Format a table as ``table``, ``markdown`` or ``latex``; options as in their functions."""
    if style == "latex":
        return latex(table, cmidrules=cmidrules)
    return markdown(table) if style == "markdown" else boxed_text(table, width=width)


_LATEX = str.maketrans(
    {c: f"\\{c}" for c in "&%$#_{}"}
    | {
        "\\": r"\textbackslash{}",
        "~": r"\textasciitilde{}",
        "^": r"\textasciicircum{}",
        "<": r"\textless{}",
        ">": r"\textgreater{}",
        "|": r"\textbar{}",
        "±": r"$\pm$",
        "\N{MINUS SIGN}": "$-$",
    }
)


def escape_latex(text: str) -> str:
    """Escape a text for LaTeX."""
    return printable(text).translate(_LATEX)
