"""Tables: means and spreads by hand, every format parses back, footnotes say what is absent."""

import csv
import io
import json
import re

import pytest
from made_runs import record

from chronoscene.bench.results import Failure
from chronoscene.bench.summary import ENTRY_COLUMNS, summarise
from chronoscene.bench.tables import footnotes, format_runs, readable_tables
from chronoscene.errors import ConfigError
from chronoscene.io.tables import FORMATS

RUNS = [
    record(seed=0, psnr=(20.0, 30.0), ssim=(0.5, 0.75)),
    record(seed=1, psnr=(22.0, 31.0), ssim=(0.5, 0.75)),
    record("3dgs", psnr=(10.0, 40.0), ssim=(0.25, 0.5), strategy="pooled"),
]
FAILURES = [
    Failure(method="3dgs", strategy="joint", preset="fast", scene="plaza", seed=s, reason="why")
    for s in (0, 1)
]


def grids(records, metrics=()):
    return readable_tables(summarise(records, metrics), records, metrics)


def notes(records, failures, metrics=()):
    return footnotes(summarise(records, metrics), records, failures, metrics)


def test_tables_mark_the_best_of_each_column():
    quality = grids(RUNS, ["psnr"])[0]
    assert quality.title == "plaza: PSNR [dB] (psnr), higher is better"
    assert quality.flat_heads == [
        "method",
        "0: May_2016 & before",
        "period 1",
        "macro",
        "micro",
        "worst",
        "n",
    ]
    # chronogs: 21, 30.5, 25.75, 25.75, 21; 3dgs: 10, 40, 25, 25, 10.
    assert quality.ranks == dict.fromkeys([(0, 1), (0, 3), (0, 4), (0, 5), (1, 2)], 1)
    assert [row[-1] for row in quality.rows] == ["2", "1"]


def test_lower_is_better_where_it_is():
    runs = [record("a", psnr=(1.0,)), record("b", psnr=(1.0,))]
    for run, value in zip(runs, (0.5, 0.25), strict=True):
        for values in (*run.aggregates.values(), *run.periods.values()):
            values["lpips_vgg"] = value
    grid = grids(runs, ["lpips_vgg"])[0]
    assert {place for place in grid.ranks if place[1] == 1} == {(1, 1)}
    ties = grids(runs, ["psnr"])[0]
    assert {place for place in ties.ranks if place[1] == 1} == {(0, 1), (1, 1)}


def test_csv_parses_back():
    lines = list(csv.DictReader(io.StringIO(format_runs(RUNS, FAILURES, "csv"))))
    assert tuple(lines[0]) == ENTRY_COLUMNS
    for line, entry in zip(lines, summarise(RUNS).itertuples(), strict=True):
        assert float(line["mean"]) == entry.mean and line["column"] == entry.column
        assert line["sd"] == ("" if entry.n == 1 else repr(entry.sd))


def test_a_spread_that_is_not_defined_is_not_empty():
    runs = [record(psnr=(float("inf"),)), record(seed=1, psnr=(1.0,))]
    first = next(csv.DictReader(io.StringIO(format_runs(runs, [], "csv"))))
    assert (first["mean"], first["sd"]) == ("inf", "nan")
    assert json.loads(format_runs(runs, [], "json"))["entries"][0]["sd"] == "NaN"


def test_json_parses_back():
    runs = [record(psnr=(float("inf"), 1.0)), *RUNS[2:]]
    text = format_runs(runs, FAILURES, "json")
    document = json.loads(text, parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    found = {(e["method"], e["quantity"], e["column"]): e["mean"] for e in document["entries"]}
    assert found["chronogs", "psnr", "period 0"] == "Infinity"
    assert found["3dgs", "psnr", "macro"] == 25.0
    assert document["notes"] == notes(runs, FAILURES)


def parse_markdown(text):
    rows = [line for line in text.splitlines() if line.startswith("| ")]
    cells = [re.split(r"(?<!\\)\|", row)[1:-1] for row in rows]
    clean = [[re.sub(r"\\(.)", r"\1", c.strip().strip("*")) for c in row] for row in cells]
    return [row for row in clean if row[0] != "---"]


def parse_latex(text):
    rows = [line for line in text.splitlines() if line.endswith(r" \\")]
    clean = []
    for row in rows:
        cells = re.split(r"(?<!\\)&", row.removesuffix(r" \\"))
        texts = [re.sub(r"\\textbf\{(.*)\}", r"\1", c.strip()) for c in cells]
        clean.append([re.sub(r"\\(.)", r"\1", c.replace(r"$\pm$", "±")) for c in texts])
    return clean


def parse_boxed(text):
    rows = [re.split(r" {2,}", line.strip()) for line in text.splitlines() if "  " in line]
    return [[re.sub("^†?[¹²³]? ?", "", cell) for cell in row] for row in rows]


@pytest.mark.parametrize(
    ("style", "parse"),
    [("markdown", parse_markdown), ("latex", parse_latex), ("table", parse_boxed)],
)
def test_texts_parse_back(style, parse):
    expected = [row for grid in grids(RUNS) for row in (grid.flat_heads, *grid.rows)]
    assert parse(format_runs(RUNS, FAILURES, style)) == expected


@pytest.mark.parametrize("style", FORMATS)
def test_metrics_can_be_chosen(style):
    text = format_runs(RUNS, [], style, ["ssim"])
    assert "ssim" in text and "psnr" not in text
    assert "training" not in text and "seconds" not in text and "primitives" not in text
    assert "checkpoint" not in text


def test_scenes_are_summed_up():
    runs = [
        record("a", psnr=(10.0, 20.0)),
        record("a", psnr=(30.0, 30.0), scene="quay", scene_hash="q"),
        record("b", psnr=(12.0, 14.0)),
    ]
    summary = grids(runs, ["psnr"])[0]
    assert summary.title == "all scenes: PSNR [dB] (psnr), macro"
    assert summary.flat_heads == ["method", "plaza", "quay", "mean of scenes"]
    assert summary.rows == [
        ["A (joint, fast)", "15.00", "30.00", "22.50"],
        ["B (joint, fast)", "13.00", "-", "-"],
    ]


def test_a_metric_that_a_seed_lacks_has_no_mean():
    runs = [RUNS[0], record(seed=1, psnr=(22.0, 31.0))]
    assert [row[1] for row in grids(runs, ["ssim"])[0].rows] == ["-"]


def test_footnotes():
    found = notes(RUNS, FAILURES)
    assert "device: cpu (Test, 2 threads)" in found and "code: abc" in found
    assert "absent: lpips_vgg: no weights" in found
    assert "failed: plaza, 3dgs (joint, fast), seed 0, 1: why" in found
    assert any("sample standard deviation" in note for note in found)
    assert not any("absent" in note for note in notes(RUNS, [], ["psnr"]))
    assert not any("standard deviation" in note for note in notes(RUNS[:1], []))


def test_without_a_finished_run_there_are_notes_only():
    assert format_runs([], FAILURES, "table").count("failed: plaza") == 1
    assert format_runs([], FAILURES, "csv") == ",".join(ENTRY_COLUMNS) + "\n"


def test_unknown_metrics_are_refused():
    with pytest.raises(ConfigError, match="expected one of lpips_vgg"):
        format_runs(RUNS, [], "csv", ["fid"])
