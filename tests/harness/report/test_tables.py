"""Tables: means and spreads by hand, every format parses back, footnotes say what is absent."""

import csv
import io
import json
import re

import pytest
from made_runs import record, scored

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import Failure
from chronoscene.harness.report.comparable import apart
from chronoscene.harness.report.published import load_published
from chronoscene.harness.report.summary import ENTRY_COLUMNS, in_region, summarise
from chronoscene.harness.report.tables import footnotes, format_runs, period_name, readable_tables
from chronoscene.harness.score.forgetting import transfer
from chronoscene.io.tables import FORMATS
from chronoscene.methods import PeriodSharing

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


def test_period_names():
    assert period_name(1, {"1": "autumn"}) == "autumn"
    assert period_name(1, {"1": "1"}) == "period 1"
    assert period_name(2, {}) == "period 2"


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


def test_what_periods_share_stands_where_it_is_known():
    shares = PeriodSharing((3, 1), (10, 20), 0, 70)
    *_, table = grids([*RUNS, record("a", sharing=shares), record("a", seed=1, sharing=shares)])
    assert table.title == "plaza: what periods share"
    assert [row[1:] for row in table.rows] == [["75.0 ± 0.0", "1.25 ± 0.00", "15 ± 0", "70 ± 0"]]
    assert table.rows[0][0] == "A (joint, fast)"
    assert grids(RUNS)[-1].title == "plaza: macro means and cost"
    assert len(notes([record("a", sharing=shares)], [])) == len(notes([record("a")], [])) + 1


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
    text = format_runs(RUNS, FAILURES, style).replace(r"\rlap{$^\dagger$}", "")
    assert parse(re.sub(r"(?<=\d) †", "", text)) == expected


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


# Of two periods; b is 0.1 worse on average, by views that differ more; c is 5 worse on each.
TRUE = [[20.0, 22.0, 21.0, 24.0], [30.0, 31.0, 29.0, 33.0]]
SCORED = [
    scored("a", psnr=TRUE),
    scored("b", psnr=[[v + d for v, d in zip(p, (2, -2, 1.5, -1.9), strict=True)] for p in TRUE]),
    scored("c", psnr=[[value - 5 for value in values] for values in TRUE]),
]


def test_intervals_differences_and_ties():
    (table,) = grids(SCORED, ["psnr"])
    assert table.heads[3:6] == ["macro", ("interval", "over views"), ("difference", "to the best")]
    a, b, c = ([cell.replace("\N{MINUS SIGN}", "-") for cell in row[3:6]] for row in table.rows)
    assert a[0] == "26.25" and re.fullmatch(r"\[2\d\.\d\d, 2\d\.\d\d\]", a[1]) and a[2] == "-"
    assert re.fullmatch(r"-0\.10 \[-\d\.\d\d, \d\.\d\d\]", b[2])
    assert c[2] == "-5.00 [-5.00, -5.00]"
    assert (1, 3) in table.ties and not {place for place in table.ties if place[0] != 1}
    found = notes(SCORED, [])
    assert any("; periods with 4 test views separate little" in n for n in found if n[0] == "†")
    assert any("[ ]: 95 %" in note for note in found)
    assert any("the spread of seeds is unknown" in note for note in found)
    assert not any(note.startswith(("†", "[ ]")) for note in notes(RUNS[1:], []))
    several = [*SCORED, scored("a", 1, psnr=[[value + 0.1 for value in p] for p in TRUE])]
    assert any("over test views and seeds" in note for note in notes(several, []))


def test_the_overview_has_metrics_and_size_side_by_side():
    (overview, *_) = grids(RUNS)
    assert overview.title == "plaza: macro means"
    assert overview.flat_heads == ["method", "PSNR [dB]", "SSIM", "checkpoint [MB]"]
    assert overview.rows[0] == ["CHRONOGS (joint, fast)", "25.75", "0.6250", "1.234"]
    both = [*RUNS, *(run.model_copy(update={"scene": "quay"}) for run in RUNS)]
    (overview, *_) = grids(both)
    assert overview.title == "all scenes: macro means"
    assert overview.heads[:5] == [
        *("method", ("plaza", "PSNR [dB]"), ("", "SSIM")),
        *(("quay", "PSNR [dB]"), ("", "SSIM")),
    ]
    assert overview.heads[5:] == [("mean of scenes", "PSNR [dB]"), ("", "SSIM"), "checkpoint [MB]"]


def test_the_overview_of_several_tests_of_a_scene_shows_the_size_of_none():
    narrow = [run.model_copy(update={"max_width": 160, "checkpoint_bytes": 5}) for run in RUNS]
    (overview, *others) = grids(apart([*RUNS, *narrow]))
    assert [first for first, _ in overview.head_lines if first] == [
        *("method", "plaza [width 1600]", "plaza [width 160]")
    ]
    assert sum("checkpoint [MB]" in table.heads for table in others) == 2


@pytest.mark.parametrize(
    ("scenes", "widths"), [(6, [16]), pytest.param(12, [15, 14], marks=pytest.mark.slow)]
)
def test_many_scenes_are_folded(scenes, widths):
    runs = [
        record(method, scene=f"s{i}", ssim=(0.5, 0.5)) for i in range(scenes) for method in "ab"
    ]
    overviews = [table for table in grids(runs) if table.title == "all scenes: macro means"]
    assert [len(table.heads) for table in overviews] == widths
    assert overviews[-1].heads[-1] == "checkpoint [MB]"


def test_many_periods_are_folded():
    runs = [record(method, psnr=tuple(range(10, 40))) for method in "ab"]
    (table,) = grids(runs, ["psnr"])
    assert table.flat_heads == [
        "method",
        "macro",
        "micro",
        "worst",
        "median of periods",
        "best",
        "n",
    ]
    assert table.rows[0][1:] == ["24.50", "24.50", "10.00", "24.50", "39.00", "1"]
    assert any("--periods" in note for note in notes(runs, []))
    made = readable_tables(summarise(runs), runs, ["psnr"], periods=True)
    assert [len(table.heads) - 1 for table in made] == [6, 8, 8, 8, 6]
    assert made[-1].title.endswith("; periods 24 to 29") and made[-1].rows[1][-1] == "39.00"
    eight = [record(psnr=tuple(range(8)))]
    assert len(grids(eight, ["psnr"])[0].heads) == 1 + 8 + 3 + 1


def test_notes_in_markdown_have_no_markup_of_their_own():
    run = record().model_copy(update={"notices": ["<img src=x> of a_b"]})
    assert "\n- \\<img src=x\\> of a\\_b\n" in format_runs([run], [], "markdown", ["psnr"])
    assert "\n<img src=x> of a_b\n" in format_runs([run], [], "table", ["psnr"])


def test_the_legend_in_markdown_looks_like_the_marks():
    text = format_runs(RUNS, [], "markdown", ["psnr"])
    assert "\n- **bold**, <ins>underlined</ins>, *italic*: the first three of a column\n- " in text


def test_published_rows_stand_below_the_measured_ones_and_are_never_marked():
    runs = [run.model_copy(update={"scene": "Lawncourt"}) for run in RUNS]
    runs.append(record("3dgs", psnr=(9.0, 9.0), scene="plaza", strategy="pooled"))
    text = format_runs(runs, [], "markdown", ["psnr"], published=load_published())
    lines = [line for line in text.split("**Lawncourt")[0].splitlines() if line.startswith("| ")]
    assert lines[2] == "| CHRONOGS (joint, fast) | **25.75** | - | - |"
    assert lines[4] == "| 3DGS (published) | 18.29 | - | - |"
    assert lines[-1] == "| ChronoGS (published) | 22.16 | - | - |" and len(lines) == 12
    assert "- published: ChronoGS: Disentangling" in text
    assert "Scenes of equal names may have other photos, test views and sizes." in text
    assert "- nothing is published of plaza; the scenes are Lawncourt, " in text
    assert text.count("(published)") == 8  # not in the tables by period
    tests = apart([record(scene="Lawncourt", max_width=width) for width in (160, 320)])
    text = format_runs(tests, [], "markdown", ["psnr"], published=load_published())
    assert "| ChronoGS (published) | 22.16 | 22.16 |" in text and "nothing is" not in text
    others = [record(m, scene=scene) for m in "ab" for scene in ("Lawncourt", "plaza")]
    for run in others:
        for values in (*run.aggregates.values(), *run.periods.values()):
            values["flip"] = 0.5
    text = format_runs(others, [], "table", ["flip"], published=load_published())
    assert "all scenes: FLIP" in text and "(published)" not in text
    boxed = format_runs(runs, [], "table", published=load_published(), width=80)
    assert max(map(len, boxed.split("\n¹, ²")[0].splitlines())) <= 80
    rows = list(
        csv.DictReader(io.StringIO(format_runs(runs, [], "csv", published=load_published())))
    )
    assert {row["source"] for row in rows if row["method"] == "CLNeRF"} == {load_published().title}
    assert {row["source"] for row in rows if row["strategy"]} == {"measured"}


def test_latex_has_as_many_columns_in_each_row_as_it_declares():
    runs = [run.model_copy(update={"scene": s}) for s in ("Lawncourt", "b_%&") for run in SCORED]
    runs += [record("d", ssim=(0.5, 0.5)), record("e", psnr=tuple(range(9)))]
    runs.append(record("f", scene="Lawncourt", psnr=(1.0, 1.0)))
    text = format_runs(runs, FAILURES, "latex", published=load_published(), periods=True)
    blocks = re.findall(r"\\begin\{tabular\}\{([lr]+)\}(.*?)\\end\{tabular\}", text, re.S)
    assert len(blocks) == text.count(r"\begin") == text.count(r"\end") > 9
    for columns, body in blocks:
        rules = re.findall(r"^\\(\w+rule)$", body, re.M)
        assert rules[0] == "toprule" and rules[-1] == "bottomrule" and "midrule" in rules
        for first, last in re.findall(r"\\cmidrule\(lr\)\{(\d+)-(\d+)\}", body):
            assert 1 < int(first) < int(last) <= len(columns)
        rows = [line for line in body.splitlines() if line.endswith(r" \\")]
        for row in rows:
            spans = [int(n) - 1 for n in re.findall(r"\\multicolumn\{(\d+)\}", row)]
            assert len(re.findall(r"(?<!\\)&", row)) + 1 + sum(spans) == len(columns)
            assert row.count("{") == row.count("}")
        assert all(line.startswith("\\") or line in ("", *rows) for line in body.splitlines())
    commands = set(re.findall(r"\\([a-z]+)", "".join(body for _, body in blocks)))
    assert commands == {
        *("toprule", "midrule", "bottomrule", "cmidrule", "multicolumn"),
        *("textbf", "underline", "textit", "rlap", "dagger"),
    }
    outside = re.sub(r"\\begin\{tabular\}.*?\\end\{tabular\}", "", text, flags=re.S)
    assert all(line.startswith("% ") for line in outside.splitlines() if line)


def in_stages(seed, *values):
    """A run whose stages gave these values: period 0 after both, period 1 untrained and so on."""
    old, forgotten, start, ahead, new = values
    stages = {
        "untrained": {"1": {"psnr": start}},
        "period-0": {"0": {"psnr": old}, "1": {"psnr": ahead}},
        "period-1": {"0": {"psnr": forgotten}, "1": {"psnr": new}},
    }
    return record(
        seed=seed,
        strategy="sequential",
        psnr=(forgotten, new),
        stages=stages,
        transfer=transfer(stages),
    )


def test_stages_have_a_matrix_and_what_is_left_at_the_end():
    runs = [in_stages(0, 30.0, 20.0, 8.0, 12.0, 31.0), in_stages(1, 32.0, 26.0, 8.0, 12.0, 31.0)]
    _, matrix, left = grids([*runs, RUNS[2]], ["psnr"])
    assert matrix.title == "plaza: PSNR [dB] (psnr) after each stage"
    assert matrix.flat_heads == ["method", "after", "0: May_2016 & before", "period 1"]
    assert matrix.rows == [
        ["CHRONOGS (sequential, fast)", "no training", "-", "8.00 ± 0.00"],
        ["", "0: May_2016 & before", "31.00 ± 1.41", "12.00 ± 0.00"],
        ["", "period 1", "23.00 ± 4.24", "31.00 ± 0.00"],
    ]
    heads = ["method", "macro", "forgetting", "backward transfer", "forward transfer"]
    assert left.flat_heads == heads
    values = ["27.00 ± 2.12", "8.00 ± 2.83", "-8.00 ± 2.83", "4.00 ± 0.00"]
    assert left.rows == [["CHRONOGS (sequential, fast)", *values]]
    many = {str(i): str(i) for i in range(9)}
    for run in runs:
        run.period_labels = many
    titles = [table.title for table in grids(runs, ["psnr"])]
    assert titles[1:] == ["plaza: PSNR [dB] (psnr) after the last stage"]
    entries = summarise(runs).query("column == 'period-0: period 1'")
    assert entries["mean"].tolist() == [12.0]


def test_joint_and_separate_training_stand_side_by_side_with_what_they_cost():
    separate = record(strategy="separate", psnr=(24.0, 30.0), checkpoint_bytes=3_000_000)
    table = grids([record(psnr=(20.0, 30.0)), separate])[-1]
    assert table.title == "plaza: macro means and cost"
    found = [dict(zip(table.flat_heads, row, strict=True)) for row in table.rows]
    names = ("PSNR [dB]", "training [s]", "iterations", "checkpoint [MB]", "peak memory [MB]")
    assert [[row[name] for name in names] for row in found] == [
        ["25.00", "10.0", "100", "1.234", "400"],
        ["27.00", "10.0", "100", "3.000", "400"],
    ]


def test_footnotes():
    found = notes(RUNS, FAILURES)
    assert "device: cpu (Test, 2 threads)" in found and "code: abc" in found
    assert "absent: lpips_vgg: no weights" in found
    assert "failed: plaza, 3dgs (joint, fast), seed 0, 1: why" in found
    assert any("sample standard deviation" in note for note in found)
    assert not any("absent" in note for note in notes(RUNS, [], ["psnr"]))
    assert not any("standard deviation" in note for note in notes(RUNS[:1], []))
    mixed = [record(seed=i, device=f"device {i}") for i in range(2)]
    assert "device: device 0; device 1" in notes(mixed, [])
    averaged = "seeds of several devices are averaged, but for their times: CHRONOGS (joint, fast)"
    assert averaged in notes(mixed, []) and averaged not in found


def test_without_a_finished_run_there_are_notes_only():
    assert format_runs([], FAILURES, "table").count("failed: plaza") == 1
    assert format_runs([], FAILURES, "csv") == ",".join(ENTRY_COLUMNS) + "\n"


def test_unknown_metrics_are_refused():
    with pytest.raises(ConfigError, match=r"expected one of .*lpips_vgg"):
        format_runs(RUNS, [], "csv", ["fid"])


def test_stages_of_whole_images_are_not_in_the_tables_of_a_region():
    run = in_stages(0, 30.0, 20.0, 8.0, 12.0, 31.0)
    run.regions, run.change_masks = {"changed": {"aggregates": {}, "periods": {}}}, "hash"
    (changed,) = in_region([run], "changed")
    assert (changed.stages, changed.transfer) == ({}, {})
