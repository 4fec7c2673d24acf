"""Pareto fronts as panels: every configuration is there, the front is drawn as steps."""

from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from chronoscene.figures.canvas import EIGHT
from chronoscene.figures.fronts import (
    DISC,
    Mark,
    Panel,
    _draw_panel,
    _limits,
    _shifts,
    draw_fronts,
    panel_svg,
)

MARKS = [
    Mark(number=1, x=1.0, y=20.0, x_spread=0.1, y_spread=0.5, on_front=True),
    Mark(number=2, x=9.0, y=25.0, on_front=True),
    Mark(number=3, x=20.0, y=19.0, on_front=False),
]


def panel_of(marks, *, title="t", lower_is_better=False):
    return Panel(
        title=title,
        x_label="training [s]",
        y_label="PSNR [dB]",
        marks=marks,
        lower_is_better=lower_is_better,
    )


def on_axis(x, spread):
    return Mark(number=1, x=x, y=1.0, x_spread=spread, on_front=True)


def draw(path, rows):
    names = ["one", "two $x$", "three"]
    draw_fronts(rows, path, names=names, groups={"a": [1, 2], "b": [3]}, note="note\nmore")
    return np.array(Image.open(path).convert("RGB"))


def test_panels_wrap_and_groups_have_colours(tmp_path, monkeypatch):
    monkeypatch.setattr("chronoscene.figures.fronts.MAX_COLUMNS", 2)
    panel = panel_of(MARKS, title="plaza")
    few = draw(tmp_path / "new/few.png", [[panel] * 2])
    many = draw(tmp_path / "many.png", [[panel] * 3])
    assert many.shape[0] > few.shape[0] and many.shape[1] == few.shape[1]
    pixels = {tuple(pixel) for pixel in few.reshape(-1, 3)}
    assert {(0xB5, 0x12, 0x1B), (0xF5, 0xC2, 0x11)} <= pixels


def test_steps_follow_the_front_on_logarithmic_costs():
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    colors = dict(zip((1, 2, 3), EIGHT, strict=False))
    _draw_panel(axes, panel_of(MARKS, lower_is_better=True), colors)
    assert axes.get_xscale() == "log" and axes.yaxis_inverted()
    steps = axes.lines[0]
    assert steps.get_drawstyle() == "steps-post"
    assert steps.get_xydata().tolist() == [[1.0, 20.0], [9.0, 25.0]]
    faces = [line.get_markerfacecolor() for line in axes.lines if line.get_marker() == "o"]
    assert faces == [EIGHT[0], EIGHT[1], "white"]
    assert [text.get_text() for text in axes.texts] == ["1", "2", "3"]


def test_costs_that_hardly_differ_are_not_spread():
    low, high = _limits([on_axis(90.01, 0.0), on_axis(90.03, 0.0)])
    assert high / low == pytest.approx(2) and low * high == pytest.approx(90.02**2)
    low, high = _limits([on_axis(1.0, 3.0), on_axis(50.0, 5.0)])
    assert 0 < low < 0.5 and high > 55


def test_discs_do_not_hide_each_other():
    there = [replace(MARKS[2], number=number, x=9.0, y=25.0) for number in (3, 4, 5)]
    marks = [MARKS[0], *there, MARKS[1]]
    shifts = _shifts(marks, *_limits(marks))
    assert shifts[1] == shifts[2] == 0, "the front stays where it is"
    assert sorted(abs(shifts[i]) for i in (3, 4, 5)) == [DISC, DISC, 2 * DISC]
    crowd = [replace(MARKS[1], number=number) for number in range(1, 30)]
    low, high = _limits(crowd)
    assert 0.0 in _shifts(crowd, low, high).values()


def test_a_panel_in_a_page_has_text_titles_and_equal_bytes():
    panel = replace(panel_of(MARKS[:1]), x_label="cost <s>")
    svg, again = (panel_svg(panel, {1: ("<b>", "#aa0000")}) for _ in range(2))
    assert svg == again and "cost &lt;s&gt;</text>" in svg and "<title>&lt;b&gt;</title>" in svg
    root = ElementTree.fromstring(svg.replace("xlink:", ""))
    assert root.get("aria-label") == "PSNR [dB] by cost <s>"
    assert not [element for element in root.iter("g") if element.get("id")]
