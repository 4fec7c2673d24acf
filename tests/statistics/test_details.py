"""The full table in its layouts, and the pool that fills it."""

import csv
import io
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest

from chronoscene.formats import read_scene
from chronoscene.statistics.counts import SCHEMA_VERSION, period_title
from chronoscene.statistics.details import COLUMNS, MAX_SHOWN, format_details, rows_of
from chronoscene.statistics.measures import SceneStatistics, measure_scene


@pytest.fixture
def statistics(make_scene_folder) -> SceneStatistics:
    folder = make_scene_folder(name="old_town", tests=["b/0003"])
    (folder / "sparse/periods.json").write_text(
        json.dumps([{"id": 0, "label": "before | after"}, {"id": 1, "label": "1"}])
    )
    return measure_scene(read_scene(folder))


def test_csv_has_every_value_in_its_stored_unit(statistics):
    rows = list(csv.DictReader(io.StringIO(format_details([statistics], "csv"))))
    assert [row["period"] for row in rows] == ["0", "1", ""]
    assert [row["label"] for row in rows] == ["before | after", "1", "all"]
    assert [row["images"] for row in rows] == ["2", "2", "4"]
    assert [row["test"] for row in rows] == ["0", "1", "1"]
    assert float(rows[1]["baseline"]) == statistics.periods[1].baseline
    assert float(rows[0]["overlap_1"]) == statistics.overlap[0][1]
    assert float(rows[0]["in_view_1"]) == statistics.in_view[0][1]
    assert rows[2]["overlap_0"] == rows[2]["overlap_1"] == rows[2]["in_view_0"] == ""


def test_csv_has_numbers_where_pandas_wants_them(statistics):
    pandas = pytest.importorskip("pandas")
    frame = pandas.read_csv(io.StringIO(format_details([statistics], "csv")))
    text = {"scene", "label", "date"}
    assert {c for c in frame if not pandas.api.types.is_numeric_dtype(frame[c])} <= text
    assert frame[frame.period == 1].label.tolist() == ["1"]
    assert frame[frame.period.isna()].images.tolist() == [4]


def test_json_has_counts_measures_and_totals(statistics):
    data = json.loads(format_details([statistics, statistics], "json"))
    scene = data["scenes"][0]
    assert scene["observations"] == sum(p["observations"] for p in scene["periods"])
    assert scene["periods"][0]["overlap"] == list(statistics.overlap[0])
    assert scene["periods"][1]["reprojection_error"] == statistics.periods[1].reprojection_error
    assert data["totals"]["all"] == {"images": 8, "points": 60}
    assert scene["periods"][1]["in_view"] == list(statistics.in_view[1])
    assert scene["unit"] == "unknown"
    assert scene["paper"] is None
    assert (data["schema_version"], data["unreadable"]) == (SCHEMA_VERSION, [])


def test_all_keys_are_in_the_documentation(statistics):
    text = (Path(__file__).parents[2] / "docs/guides/statistics.md").read_text(encoding="utf-8")
    data = json.loads(format_details([statistics], "json"))
    scene = data["scenes"][0]
    for key in {*data, *scene, *scene["periods"][0]}:
        assert f"`{key}`" in text, key


def test_text_markdown_and_latex_have_one_line_per_row(statistics):
    text = format_details([statistics], "table")
    assert "old_town" in text and "0: before | after" in text
    (first,) = [line for line in text.splitlines() if "old_town" in line]
    error = f"{statistics.periods[0].reprojection_error:.3f}"
    assert error in first.split()
    lines = format_details([statistics], "markdown").splitlines()
    assert len(lines) == 5
    assert {line.replace("\\|", "").count("|") for line in lines} == {len(COLUMNS) + 7}
    latex = format_details([statistics, statistics], "latex")
    assert latex.count(r"old\_town") == 2 and latex.count(r"\midrule") == 2
    body = [line for line in latex.splitlines() if line.endswith(r"\\")]
    wide = [sum(int(n) - 1 for n in re.findall(r"multicolumn{(\d+)}", line)) for line in body]
    columns = [line.count("&") + n for line, n in zip(body, wide, strict=True)]
    assert set(columns) == {len(COLUMNS) + 5}


def test_one_period_has_no_overlap_columns(make_scene_folder):
    one = measure_scene(read_scene(make_scene_folder({"1.png": 0, "2.png": 0})))
    assert "Also seen by" not in format_details([one], "table")
    assert len(rows_of(one)) == 2


def test_many_periods_keep_the_table_narrow(make_scene_folder):
    count = MAX_SHOWN + 1
    many = measure_scene(read_scene(make_scene_folder({f"{i}.png": i for i in range(count)})))
    assert "Also seen by" not in format_details([many], "table")
    assert f"overlap_{count - 1}" in format_details([many], "csv").splitlines()[0]


def test_markup_in_names_is_only_text(make_scene_folder):
    scene = measure_scene(read_scene(make_scene_folder(name="[red]x:smile:")))
    assert "[red]x:smile:" in format_details([scene], "table")


def test_narrow_terminals_get_the_table_in_blocks(statistics):
    text = format_details([statistics], "table", width=60)
    assert max(map(len, text.splitlines())) <= 60
    assert text.count("old_town") == text.count("Scene") > 1
    for title in ("Observations", "Coverage", "Also seen by", "In view of"):
        assert text.count(title) == 1
    wide = format_details([statistics], "table")
    needed = max(map(len, wide.splitlines()))
    assert format_details([statistics], "table", width=needed + 2) == wide
    assert set(re.findall(r"[\d.,]+", text)) == set(re.findall(r"[\d.,]+", wide))


@pytest.mark.parametrize("output_format", ["table", "markdown", "latex"])
def test_names_cannot_break_a_line(make_scene_folder, output_format):
    scene = measure_scene(read_scene(make_scene_folder()))
    nasty = replace(scene, counts=replace(scene.counts, name="a\nb\x1b[31m"))
    text = format_details([nasty], output_format)
    plain = format_details([scene], output_format)
    assert "\x1b" not in text and text.count("\n") == plain.count("\n")


def test_a_period_is_called_by_what_is_known():
    assert period_title(1, "1", None) == "1"
    assert period_title(1, "flood", None) == "1: flood"
    assert period_title(1, "1", "2016-07") == "1: 2016-07"
    assert period_title(1, "flood", "2016-07") == "1: flood, 2016-07"
    assert period_title(1, "summer 2016", "2016-07") == "1: summer 2016"
