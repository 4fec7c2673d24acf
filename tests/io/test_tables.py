"""Tables as text: special characters are escaped, rows keep their cells."""

import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.io.tables import (
    Table,
    boxed_text,
    csv_text,
    escape_latex,
    latex,
    markdown,
    markdown_list,
    plain_text,
    text_of,
)

HEADS = ["name", ("size", "[m]"), ("", "[px]")]
TABLE = Table(
    HEADS, [["a_b", "1.0", "2"], ["[c", "30.5", "4"]], title="Sizes", ranks={(1, 1): 1}, breaks={0}
)


def test_heads_on_one_line_are_complete():
    assert TABLE.flat_heads == ["name", "size [m]", "size [px]"]


def test_plain():
    assert plain_text(TABLE).splitlines() == [
        "Sizes",
        "name  size [m]  size [px]",
        "----  --------  ---------",
        "a_b        1.0          2",
        "[c        30.5          4",
    ]


def test_markdown():
    assert markdown(TABLE).splitlines() == [
        "**Sizes**",
        "",
        "| name | size [m] | size [px] |",
        "| --- | ---: | ---: |",
        "| a_b | 1.0 | 2 |",
        r"| \[c | **30.5** | 4 |",
    ]
    assert r"a\_b" in markdown(TABLE, special="_")


def test_a_list_has_no_markup_of_its_own():
    """Nor check boxes, as which an item that begins with [ ] is shown."""
    text = markdown_list(["failed: <b>a_b</b>\nof *c*", "[ ]: `d`"])
    assert text == "- failed: \\<b\\>a\\_b\\</b\\>\\\\nof \\*c\\*\n- \\[ ]: \\`d\\`\n"


@pytest.mark.parametrize("style", ["table", "markdown", "latex"])
def test_names_of_several_lines_are_on_one(style):
    odd = Table(["a\nb", ("c\rd", "e\nf")], [["g\nh", "1"]], title="i\nj")
    plain = Table(["a", ("c", "e")], [["g", "1"]], title="i")
    found = text_of(odd, style)
    assert found.count("\n") == text_of(plain, style).count("\n")
    assert "\r" not in found and found.splitlines()[0].endswith(("j", "j**"))


@pytest.mark.parametrize("cmidrules", [False, True])
def test_latex(cmidrules):
    lines = latex(TABLE, cmidrules=cmidrules).splitlines()
    rules = [r"\cmidrule(lr){2-3}"] if cmidrules else []
    assert lines == [
        "% Sizes",
        r"\begin{tabular}{lrr}",
        r"\toprule",
        r"name & \multicolumn{2}{c}{size} \\",
        *rules,
        r" & [m] & [px] \\",
        r"\midrule",
        r"a\_b & 1.0 & 2 \\",
        r"\midrule",
        r"{}[c & \textbf{30.5} & 4 \\",  # a bracket after the end of a row would be its option
        r"\bottomrule",
        r"\end{tabular}",
    ]


def test_negative_numbers_of_latex_have_a_minus():
    table = Table(["n-1", "a", "b", "c"], [["-2 x", "-0.52 ± 0.10", "2016-05-03", "-"]])
    row = latex(table).splitlines()[4]
    assert row == r"-2 x & $-$0.52 $\pm$ 0.10 & 2016-05-03 & - \\"


def test_ranks_and_ties_are_marked():
    rows = [[name, value] for name, value in zip("abcd", ("9", "8", "7", "6"), strict=True)]
    ranks = {(0, 1): 1, (1, 1): 2, (2, 1): 3}
    table = Table(["n", "v"], rows, ranks=ranks, ties={(1, 1), (3, 1)})
    assert [line.split(maxsplit=1)[1] for line in boxed_text(table).split("\n")[3:7]] == [
        *("¹ 9", "†² 8", "³ 7", "†6")
    ]
    assert [line.split(" | ")[1] for line in markdown(table).splitlines()[2:]] == [
        *("**9** |", "<ins>8</ins> † |", "*7* |", "6 † |")
    ]
    assert [line.split(" & ")[1] for line in latex(table).splitlines()[4:8]] == [
        r"\textbf{9} \\",
        r"\underline{8}\rlap{$^\dagger$} \\",
        r"\textit{7} \\",
        r"6\rlap{$^\dagger$} \\",
    ]


def test_labels_go_over_lines_where_that_saves_a_block():
    name = "Scaffold-GS, period appearance (joint, fast)"
    table = Table(["method", *["x" * 15] * 3], [[name, "1", "2", "3"]], title="Title")
    lines = boxed_text(table, width=80).splitlines()
    assert lines[0] == "Title" and max(map(len, lines)) <= 80
    texts = [line.split("  ")[0].strip() for line in lines]
    assert sum(text == "method" for text in texts) == 1  # one block
    first = texts.index("Scaffold-GS, period")
    assert texts[first : first + 2] == ["Scaffold-GS, period", "appearance (joint, fast)"]
    assert name in boxed_text(table)
    heads = ["method", *[("plaza", "x" * 12), ("", "x" * 12), ("", "x" * 12)] * 2]
    text = boxed_text(Table(heads, [[name, *"123456"]]), width=80)
    assert text.count("plaza") == 2 and max(map(len, text.splitlines())) <= 80


def test_csv():
    assert csv_text(["a", "b"], [[1, None], ["x,y", 0.5]]) == 'a,b\n1,\n"x,y",0.5\n'


def test_wide_tables_are_cut_into_blocks_with_their_labels():
    assert boxed_text(TABLE).count("name") == 1
    heads = [*HEADS, "other"]
    wide = Table(heads, [[*row, "x" * 8] for row in TABLE.rows])
    text = boxed_text(wide, width=20)
    assert text.count("name") == 2 and max(map(len, text.splitlines())) <= 20


@given(st.text(alphabet="a\\&%$#_{}~^±<>| ", max_size=20))
def test_latex_text_has_no_bare_special_character(text):
    rest = re.sub(r"\\text\w+\{\}|\\[&%$#_{}]|\$\\pm\$", "", escape_latex(text))
    assert not set(rest) & set("\\&%$#_{}~^±<>|")
