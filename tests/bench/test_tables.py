"""Tables: means and spreads by hand, every format parses back, footnotes say what is absent."""

import csv
import io
import json
import re

import pytest

from chronoscene.bench.results import Failure, RunRecord
from chronoscene.bench.tables import (
    ENTRY_COLUMNS,
    footnotes,
    format_runs,
    read_runs,
    readable_tables,
    summarise,
)
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.io.tables import FORMATS


def record(method="chronogs", seed=0, *, psnr=(20.0, 30.0), ssim=None, **changes):
    """A run of one test view per period."""
    values = {"psnr": psnr} | ({"ssim": ssim} if ssim else {})
    mean = {name: sum(v) / len(v) for name, v in values.items()}
    fields = {
        "method": method,
        "strategy": "joint",
        "scene": "plaza",
        "seed": seed,
        "aggregates": {
            "macro": mean,
            "micro": dict(mean),
            "worst": {name: min(v) for name, v in values.items()},
        },
        "periods": {str(i): {name: v[i] for name, v in values.items()} for i in range(len(psnr))},
        "seconds": 10.0,
        "iterations": 100,
        "primitives": 5000,
        "checkpoint_bytes": 1_234_000,
        "peak_memory_bytes": 400_000_000,
        "device": "cpu (Test, 2 threads)",
        "commit": "abc",
        "skipped": {"lpips_vgg": "no weights"},
        "title": method.upper(),
        "preset": "fast",
        "method_version": "1",
        "config_hash": f"hash-of-{method}",
        "scene_hash": "s",
        "split_hash": "p",
        "period_labels": {"0": "May_2016 & before", "1": "1"},
        "parameters": 1,
        "warmup_seconds": 0.0,
        "setup_seconds": 0.0,
        "render_seconds": 0.0,
        "peak_device_memory_bytes": None,
        "threads": 2,
        "max_width": 1600,
        "libraries": {},
        "started": "2026-01-01T00:00:00+00:00",
        "notices": [],
    }
    return RunRecord(**{**fields, **changes})


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


def test_statistics_by_hand():
    runs = [record(seed=i, psnr=(value,)) for i, value in enumerate((1.0, 2.0, 4.0))]
    (value,) = summarise(runs).query("quantity == 'psnr' and column == 'macro'").itertuples()
    assert value.mean == pytest.approx(7 / 3) and value.n == 3
    assert value.sd == pytest.approx(1.5275252316519468)
    assert value.text == "2.33 ± 1.53"
    (value,) = summarise(runs[:1]).query("quantity == 'checkpoint_bytes'").itertuples()
    assert (value.mean, value.n, value.text) == (1_234_000.0, 1, "1.234")
    runs = [record(psnr=(float("inf"),)), record(seed=1, psnr=(1.0,))]
    assert summarise(runs).text[0] == "inf ± nan"


def test_entries_by_hand():
    found = {(e.method, e.quantity, e.column): e for e in summarise(RUNS).itertuples()}
    mine = found["chronogs", "psnr", "period 0"]
    assert (mine.mean, mine.n, mine.seeds) == (21.0, 2, "0 1")
    assert mine.sd == pytest.approx(2**0.5)
    assert found["chronogs", "psnr", "macro"].mean == 25.75
    assert found["chronogs", "psnr", "worst"].mean == 21.0
    assert found["3dgs", "psnr", "worst"].mean == 10.0 and found["3dgs", "psnr", "worst"].n == 1
    assert found["3dgs", "checkpoint_bytes", ""].mean == 1_234_000
    assert ("3dgs", "peak_device_memory_bytes", "") not in found


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
    assert quality.best == {(0, 1), (0, 3), (0, 4), (0, 5), (1, 2)}
    assert [row[-1] for row in quality.rows] == ["2", "1"]


def test_lower_is_better_where_it_is():
    runs = [record("a", psnr=(1.0,)), record("b", psnr=(1.0,))]
    for run, value in zip(runs, (0.5, 0.25), strict=True):
        for values in (*run.aggregates.values(), *run.periods.values()):
            values["lpips_vgg"] = value
    grid = grids(runs, ["lpips_vgg"])[0]
    assert {place for place in grid.best if place[1] == 1} == {(1, 1)}
    ties = grids(runs, ["psnr"])[0]
    assert {place for place in ties.best if place[1] == 1} == {(0, 1), (1, 1)}


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


def parse_plain(text):
    rows = [re.split(r" {2,}", line.strip()) for line in text.splitlines() if "  " in line]
    return [[cell.removesuffix(" *") for cell in row] for row in rows if set(row[0]) != {"-"}]


@pytest.mark.parametrize(
    ("style", "parse"),
    [("markdown", parse_markdown), ("latex", parse_latex), ("table", parse_plain)],
)
def test_texts_parse_back(style, parse):
    expected = [row for grid in grids(RUNS) for row in (grid.flat_heads, *grid.rows)]
    assert parse(format_runs(RUNS, FAILURES, style)) == expected


@pytest.mark.parametrize("style", FORMATS)
def test_metrics_can_be_chosen(style):
    text = format_runs(RUNS, [], style, ["ssim"])
    assert "ssim" in text and "psnr" not in text


def test_scenes_are_summed_up():
    runs = [
        record("a", psnr=(10.0, 20.0)),
        record("a", psnr=(30.0, 30.0), scene="quay", scene_hash="q"),
        record("b", psnr=(12.0, 14.0)),
    ]
    summary = grids(runs)[-1]
    assert summary.flat_heads == ["method", "plaza", "quay", "mean of scenes"]
    assert summary.rows == [
        ["A (joint, fast)", "15.00", "30.00", "22.50"],
        ["B (joint, fast)", "13.00", "-", "-"],
    ]


def test_runs_with_other_configs_stay_apart():
    other = record(config_hash="another", seed=0, psnr=(1.0, 2.0))
    assert summarise([*RUNS[:2], other]).label.unique().tolist() == [
        "CHRONOGS (joint, fast) [config hash-o]",
        "CHRONOGS (joint, fast) [config anothe]",
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


def test_folders_of_runs(runs, tmp_path):
    records, failures = read_runs([runs])
    assert len(records) == 4 and len(failures) == 3
    (tmp_path / "empty").mkdir()
    with pytest.raises(CheckpointError, match="no run in it; run bench first"):
        read_runs([runs, tmp_path / "empty"])
