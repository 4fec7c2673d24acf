"""The front has what no cheaper method reaches; the plot puts it where the axes say."""

import math
from itertools import combinations

import pytest

from leaderboard.pareto import BOTTOM, CHARACTER, HEIGHT, LEFT, RIGHT, TOP, WIDTH, Point, plot

POINTS = [Point("a", 10, 20), Point("b", 100, 30), Point("c", 50, 19), Point("d", 100, 25)]


def test_points_lie_inside_and_in_order():
    made = plot(POINTS, cost="s", quality="dB")
    assert made is not None
    points = {p["label"]: p for p in made["points"]}
    assert all(LEFT < p["x"] < WIDTH - RIGHT for p in points.values())
    assert all(TOP < p["y"] < HEIGHT - BOTTOM for p in points.values())
    assert points["b"]["x"] == points["d"]["x"] and points["b"]["y"] < points["d"]["y"]
    # The axis is logarithmic: 10 to 50 is as far as log 5.
    share = (points["c"]["x"] - points["a"]["x"]) / (points["b"]["x"] - points["a"]["x"])
    assert share == pytest.approx(math.log10(5), abs=2e-3)
    assert [p["label"] for p in made["points"] if p["best"]] == ["a", "b"]
    made = plot([Point("y", 2, 5), Point("x", 1, 5)], cost="s", quality="dB")
    assert [p["label"] for p in made["points"] if p["best"]] == ["x"]


def test_ticks_are_round_and_inside():
    made = plot(POINTS, cost="s", quality="dB")
    assert [text for _, text in made["across"]] == ["10", "20", "50", "100"]
    assert [text for _, text in made["up"]] == ["18", "20", "22", "24", "26", "28", "30"]


def test_labels_do_not_cover_each_other_nor_points():
    names = ["one", "a long name, with more", "three", "4"]
    close = [Point(name, 10 * 1.2**i, 20 + i / 5) for i, name in enumerate(names)]
    points = plot([*close, Point("far", 90, 30)], cost="s", quality="dB")["points"]
    boxes = [(p["x"] - 5, p["y"] - 5, p["x"] + 5, p["y"] + 5) for p in points]
    for p in points:
        width = CHARACTER * len(p["label"])
        left = p["label_x"] - width * {"start": 0, "middle": 0.5, "end": 1}[p["anchor"]]
        assert left >= LEFT and left + width <= WIDTH - RIGHT
        boxes.append((left, p["label_y"] - 11, left + width, p["label_y"] + 2))
    for (a, b, c, d), (e, f, g, h) in combinations(boxes, 2):
        assert min(c, g) <= max(a, e) or min(d, h) <= max(b, f)


@pytest.mark.parametrize("costs", [[], [10], [90.0, 90.1, 90.2], [0, 10]])
def test_equal_costs_need_no_plot(costs):
    assert plot([Point("x", cost, i) for i, cost in enumerate(costs)], cost="", quality="") is None
