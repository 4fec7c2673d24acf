"""The full table in its layouts, and the pool that fills it."""

import csv
import io
import json

import pytest

from chronoscene.formats import read_scene
from chronoscene.stats import DETAIL_WRITERS, SceneStatistics, measure_scene
from chronoscene.stats.details import COLUMNS, MOST_SHOWN, rows_of


@pytest.fixture
def statistics(make_scene_folder) -> SceneStatistics:
    folder = make_scene_folder(name="old_town", tests=["b/0003"])
    (folder / "sparse/periods.json").write_text(
        json.dumps([{"id": 0, "label": "before | after"}, {"id": 1, "label": "1"}])
    )
    return measure_scene(read_scene(folder))


def test_csv_has_every_value_in_its_stored_unit(statistics):
    rows = list(csv.DictReader(io.StringIO(DETAIL_WRITERS["csv"]([statistics]))))
    assert [row["period"] for row in rows] == ["0", "1", "all"]
    assert [row["label"] for row in rows] == ["before | after", "1", "all"]
    assert [row["images"] for row in rows] == ["2", "2", "4"]
    assert [row["test"] for row in rows] == ["0", "1", "1"]
    assert float(rows[1]["baseline"]) == statistics.periods[1].baseline
    assert float(rows[0]["overlap_1"]) == statistics.overlap[0][1]
    assert rows[2]["overlap_0"] == rows[2]["overlap_1"] == ""


def test_json_has_counts_measures_and_totals(statistics):
    data = json.loads(DETAIL_WRITERS["json"]([statistics, statistics]))
    scene = data["scenes"][0]
    assert scene["observations"] == sum(p["observations"] for p in scene["periods"])
    assert scene["periods"][0]["overlap"] == list(statistics.overlap[0])
    assert scene["periods"][1]["reprojection_error"] == statistics.periods[1].reprojection_error
    assert data["totals"]["all"] == {"images": 8, "points": 60}
    assert scene["unit"] == "unknown"


def test_text_markdown_and_latex_have_one_line_per_row(statistics):
    text = DETAIL_WRITERS["table"]([statistics])
    assert "old_town" in text and "0: before | after" in text
    (first,) = [line for line in text.splitlines() if "old_town" in line]
    error = f"{statistics.periods[0].reprojection_error:.3f}"
    assert error in first.split()
    lines = DETAIL_WRITERS["markdown"]([statistics]).splitlines()
    assert len(lines) == 5
    assert {line.replace("\\|", "").count("|") for line in lines} == {len(COLUMNS) + 5}
    latex = DETAIL_WRITERS["latex"]([statistics, statistics])
    assert latex.count(r"old\_town") == 2 and latex.count(r"\midrule") == 2
    body = [line for line in latex.splitlines() if line.endswith(r"\\")]
    assert {line.replace(r"\&", "").count("&") for line in body} == {len(COLUMNS) + 3}


def test_one_period_has_no_overlap_columns(make_scene_folder):
    one = measure_scene(read_scene(make_scene_folder({"1.png": 0, "2.png": 0})))
    assert "Also seen by" not in DETAIL_WRITERS["table"]([one])
    assert len(rows_of(one)) == 2


def test_many_periods_keep_the_table_narrow(make_scene_folder):
    count = MOST_SHOWN + 1
    many = measure_scene(read_scene(make_scene_folder({f"{i}.png": i for i in range(count)})))
    assert "Also seen by" not in DETAIL_WRITERS["table"]([many])
    assert f"overlap_{count - 1}" in DETAIL_WRITERS["csv"]([many]).splitlines()[0]


def test_markup_in_names_is_only_text(make_scene_folder):
    scene = measure_scene(read_scene(make_scene_folder(name="[red]x:smile:")))
    assert "[red]x:smile:" in DETAIL_WRITERS["table"]([scene])
