"""The front has what no cheaper method reaches; the plot names and colours its methods."""

import re

import pytest

from leaderboard.pareto import Point, plot

LEGEND = {1: ("a & b", "#aa0000"), 2: ("b", "#00bb00"), 3: ("c", "#0000cc"), 4: ("d", "#00dddd")}
POINTS = [Point(1, 10, 20), Point(2, 100, 30), Point(3, 50, 19), Point(4, 100, 25)]


def filled(svg):
    """Numbers whose discs are filled, as those on the front are."""
    discs = re.findall(r"<title>(.*?)</title>.*?<use .*?fill: (#\w+)", svg, re.DOTALL)
    assert {name for name, _ in discs} <= {"a &amp; b", "b", "c", "d"}
    colors = {color: number for number, (_, color) in LEGEND.items()}
    return sorted(colors[color] for _, color in discs if color != "#ffffff")


def test_the_front_has_the_best_for_their_cost():
    svg = plot(POINTS, LEGEND, cost="time [s]", metric="psnr")
    assert filled(svg) == [1, 2]
    assert "time [s]</text>" in svg and "PSNR [dB]</text>" in svg
    assert filled(plot(POINTS, LEGEND, cost="time [s]", metric="lpips_vgg")) == [1, 3]
    assert filled(plot([Point(2, 2, 5), Point(1, 1, 5)], LEGEND, cost="s", metric="psnr")) == [1]
    same = [Point(1, 100, 5), Point(2, 100.5, 6), Point(3, 300, 7)]
    assert filled(plot(same, LEGEND, cost="s", metric="psnr")) == [1, 2, 3]
    assert filled(plot(same, LEGEND, cost="s", metric="psnr", tolerance=0.01)) == [2, 3]


@pytest.mark.parametrize("costs", [[], [10], [90.0, 90.1, 90.2], [0, 10]])
def test_equal_costs_need_no_plot(costs):
    points = [Point(i, cost, i) for i, cost in enumerate(costs, 1)]
    assert plot(points, LEGEND, cost="", metric="psnr") is None
