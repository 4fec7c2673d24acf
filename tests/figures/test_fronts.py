"""Pareto fronts as panels: every configuration is there, the front is drawn as steps."""

from xml.etree import ElementTree

import numpy as np
import pytest
from PIL import Image

from chronoscene.figures.canvas import EIGHT
from chronoscene.figures.fronts import Mark, Panel, _draw_panel, _limits, draw_fronts, panel_svg

MARKS = [Mark(1, 1.0, 20.0, 0.1, 0.5, True), Mark(2, 9.0, 25.0, 0.0, 0.0, True)]
MARKS.append(Mark(3, 20.0, 19.0, 0.0, 0.0, False))


def draw(path, rows):
    names = ["one", "two $x$", "three"]
    draw_fronts(rows, path, names=names, groups={"a": [1, 2], "b": [3]}, note="note\nmore")
    return np.array(Image.open(path).convert("RGB"))


def test_panels_wrap_and_groups_have_colours(tmp_path, monkeypatch):
    monkeypatch.setattr("chronoscene.figures.fronts.MAX_COLUMNS", 2)
    panel = Panel("plaza", "training [s]", "PSNR [dB]", MARKS, lower_is_better=False)
    few = draw(tmp_path / "new/few.png", [[panel] * 2])
    many = draw(tmp_path / "many.png", [[panel] * 3])
    assert many.shape[0] > few.shape[0] and many.shape[1] == few.shape[1]
    pixels = {tuple(pixel) for pixel in few.reshape(-1, 3)}
    assert {(0xB5, 0x12, 0x1B), (0xF5, 0xC2, 0x11)} <= pixels


def test_steps_follow_the_front_on_logarithmic_costs():
    from matplotlib.figure import Figure

    axes = Figure().add_subplot()
    colors = dict(zip((1, 2, 3), EIGHT, strict=False))
    _draw_panel(axes, Panel("t", "x", "y", MARKS, lower_is_better=True), colors)
    assert axes.get_xscale() == "log" and axes.yaxis_inverted()
    steps = axes.lines[0]
    assert steps.get_drawstyle() == "steps-post"
    assert steps.get_xydata().tolist() == [[1.0, 20.0], [9.0, 25.0]]
    faces = [line.get_markerfacecolor() for line in axes.lines if line.get_marker() == "o"]
    assert faces == [EIGHT[0], EIGHT[1], "white"]
    assert [text.get_text() for text in axes.texts] == ["1", "2", "3"]


def test_costs_that_hardly_differ_are_not_spread():
    low, high = _limits([Mark(1, 90.01, 1.0, 0.0, 0.0, True), Mark(2, 90.03, 1.0, 0.0, 0.0, True)])
    assert high / low == pytest.approx(2) and low * high == pytest.approx(90.02**2)
    low, high = _limits([Mark(1, 1.0, 1.0, 3.0, 0.0, True), Mark(2, 50.0, 1.0, 5.0, 0.0, True)])
    assert 0 < low < 0.5 and high > 55


def test_a_panel_in_a_page_has_text_titles_and_equal_bytes():
    panel = Panel("", "cost <s>", "quality", [Mark(1, 1.0, 2.0, 0.0, 0.0, True)], False)
    svg, again = (panel_svg(panel, {1: ("<b>", "#aa0000")}) for _ in range(2))
    assert svg == again and "cost &lt;s&gt;</text>" in svg and "<title>&lt;b&gt;</title>" in svg
    root = ElementTree.fromstring(svg.replace("xlink:", ""))
    assert root.get("aria-label") == "quality by cost <s>"
    assert not [element for element in root.iter("g") if element.get("id")]
