"""Counts by period: the rule, its sums, and the layouts."""

import csv
import io
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.formats import read_scene
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.scene.splits import split_hash
from chronoscene.statistics.counts import (
    PeriodCount,
    SceneCount,
    assign_points,
    count_scene,
    count_table,
    format_counts,
)

CAMERA = Camera(1, "PINHOLE", 8, 8, (8.0, 8.0, 4.0, 4.0))


def scene_of(frame_periods: list[int], tracks: list[list[int]]) -> Scene:
    """A scene from the period of each frame and the frames that see each point."""
    frames = tuple(
        Frame(f"{i:02d}.png", i + 1, CAMERA, np.eye(4), p, "test" if i == 0 else "train")
        for i, p in enumerate(frame_periods)
    )
    flat = [frame for track in tracks for frame in track]
    points = replace(
        Points.empty(),
        ids=np.arange(len(tracks)),
        xyz=np.zeros((len(tracks), 3)),
        track_start=np.cumsum([0, *map(len, tracks)]),
        track_frame=np.array(flat, np.int32),
        track_xy=np.zeros((len(flat), 2)),
    )
    periods = tuple(Period(i, str(i)) for i in range(1 + max(frame_periods)))
    return Scene("s", Path("s"), Path("s"), frames, points, periods, "rule", "chronoscene")


@st.composite
def scenes(draw) -> Scene:
    periods = draw(st.integers(1, 4))
    extra = draw(st.lists(st.integers(0, periods - 1), max_size=6))
    frames = [*range(periods), *extra]
    tracks = st.lists(st.lists(st.integers(0, len(frames) - 1), max_size=6), max_size=20)
    return scene_of(frames, draw(tracks))


def test_a_point_belongs_to_the_period_that_observes_it_most():
    tracks = [[0], [0, 2, 3], [1, 2], [3, 0], [2, 3, 0, 1], [], [4, 4, 0]]
    scene = scene_of([0, 0, 1, 1, 2], tracks)
    assert assign_points(scene.count_views()).tolist() == [0, 1, 0, 0, 0, -1, 2]
    counted = count_scene(scene)
    assert [p.points for p in counted.periods] == [4, 1, 1]
    assert (counted.points, counted.points_without_period) == (7, 1)
    seen = count_scene(scene, count="seen")
    assert [p.points for p in seen.periods] == [6, 4, 1]
    assert (seen.points, seen.count) == (7, "seen")


@given(scenes())
def test_assigned_periods_add_up_and_seen_ones_do_not_fall_short(scene):
    assigned, seen = count_scene(scene), count_scene(scene, count="seen")
    total = sum(p.points for p in assigned.periods) + assigned.points_without_period
    assert total == assigned.points == len(scene.points)
    assert sum(p.images for p in assigned.periods) == assigned.images == len(scene.frames)
    assert all(p.images == p.train + p.test for p in assigned.periods)
    for a, s in zip(assigned.periods, seen.periods, strict=True):
        assert a.points <= s.points <= len(scene.points)


@given(scenes())
def test_assignment_equals_a_plain_loop(scene):
    """The rule spelt out point by point."""
    counts = scene.count_views()
    assigned = assign_points(scene.count_views())
    for i in range(len(scene.points)):
        span = slice(*scene.points.track_start[i : i + 2])
        periods = [scene.frames[j].period for j in scene.points.track_frame[span]]
        assert counts[i].tolist() == [periods.count(p) for p in range(scene.num_periods)]
        best = max(range(scene.num_periods), key=lambda p: (periods.count(p), -p))
        assert assigned[i] == (best if periods else -1)


def test_a_scene_without_points():
    scene = replace(scene_of([0, 1], []), points=Points.empty())
    assert [p.points for p in count_scene(scene).periods] == [0, 0]
    assert [p.points for p in count_scene(scene, count="seen").periods] == [0, 0]


def published(name: str, rows: list[tuple[int, int]]) -> SceneCount:
    periods = tuple(
        PeriodCount(i, str(i), None, images, images, 0, points)
        for i, (images, points) in enumerate(rows)
    )
    sums = [sum(column) for column in zip(*rows, strict=True)]
    return SceneCount(name, name, "x", "r", "h", "assigned", periods, sums[0], sums[1], 0)


COUNTS = [
    published("Lawncourt", [(234, 85655), (193, 57884), (277, 117595)]),
    published("Street_1", [(200, 110591), (200, 108932), (200, 95038), (200, 101074)]),
]
"""Two rows of the paper's table of counts."""


def test_table_of_the_paper():
    assert count_table(COUNTS) == [
        ["Lawncourt", 234, 85655, 193, 57884, 277, 117595, None, None, 704, 261134],
        ["Street_1", 200, 110591, 200, 108932, 200, 95038, 200, 101074, 800, 415635],
        ["Total", 434, 196246, 393, 166816, 477, 212633, 200, 101074, 1504, 676769],
    ]


def test_text():
    lines = format_counts(COUNTS, "table").strip().splitlines()
    (row,) = [line for line in lines if "Lawncourt" in line]
    assert row.split() == [
        *("Lawncourt", "234", "85,655", "193", "57,884", "277", "117,595", "-", "-"),
        *("704", "261,134"),
    ]
    assert lines[-1].split()[0] == "Total"
    assert "Period 3" in format_counts(COUNTS, "table") and "Period 4" not in format_counts(
        COUNTS, "table"
    )


def test_csv():
    rows = list(csv.reader(io.StringIO(format_counts(COUNTS, "csv"))))
    assert rows[0][:3] == ["scene", "period_0_images", "period_0_points"]
    assert rows[0][-2:] == ["total_images", "total_points"]
    assert rows[1] == [
        "Lawncourt",
        *["234", "85655", "193", "57884", "277", "117595"],
        "",
        "",
        "704",
        "261134",
    ]
    assert len(rows) == 4 and {len(row) for row in rows} == {11}


def test_markdown():
    lines = format_counts(COUNTS, "markdown").splitlines()
    assert lines[2] == (
        "| Lawncourt | 234 | 85,655 | 193 | 57,884 | 277 | 117,595 | - | - | 704 | 261,134 |"
    )
    assert {line.count("|") for line in lines} == {12}
    assert r"a\|b" in format_counts([replace(COUNTS[0], name="a|b")], "markdown")


def test_latex():
    text = format_counts(COUNTS, "latex")
    assert r"Street\_1 & 200 & 110,591" in text
    assert r"\begin{tabular}{lrrrrrrrrrr}" in text
    rows = [line for line in text.splitlines() if line.startswith(("Lawn", "Street", "Total"))]
    assert {line.count("&") for line in rows} == {10}
    assert r"\textbackslash{}\%" in format_counts([replace(COUNTS[0], name="\\%")], "latex")


def test_markup_in_names_is_only_text():
    assert "[red]x[/red]:smile:" in format_counts(
        [replace(COUNTS[0], name="[red]x[/red]:smile:")], "table"
    )


def test_json(make_scene_folder):
    scene = read_scene(make_scene_folder(tests=["b/0003"]))
    data = json.loads(format_counts([count_scene(scene)], "json"))
    (entry,) = data["scenes"]
    assert entry["split_hash"] == split_hash(scene)
    assert [(p["images"], p["train"], p["test"]) for p in entry["periods"]] == [
        (2, 2, 0),
        (2, 1, 1),
    ]
    assert data["totals"]["all"] == {"images": 4, "points": 30}
    assert sum(p["points"] for p in data["totals"]["periods"]) == 30


@pytest.mark.parametrize("style", ["table", "csv", "markdown", "latex", "json"])
def test_one_period(style):
    text = format_counts([published("one", [(3, 5)])], style)
    assert "Total" in text or style == "json"


def test_real_scenes(shared_data):
    for name, seen in (("plaza", [9785, 10131, 9203]), ("sheffield_scene", [19714, 19685])):
        scene = read_scene(shared_data / name)
        assert [p.points for p in count_scene(scene, count="seen").periods] == seen
        assert sum(p.points for p in count_scene(scene).periods) == len(scene.points)
