"""``chronoscene tradeoff``: formats, the figure, and the sentence for limits."""

import csv
import io
import json
from functools import partial

import pytest
from command_line import invoke
from made_runs import record, rows_of

from chronoscene.cli.report.tradeoff import parse_size
from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import write_run
from chronoscene.io.tables import FORMATS

CURVE = "seconds,iteration,primitives,psnr,parameters,model\n2,1,1,10,1,all\n8,2,1,20,1,all\n"


@pytest.fixture
def runs(tmp_path):
    """Two methods, written by hand."""
    for method, psnr, seconds in (("quick", 20.0, 8.0), ("slow", 25.0, 80.0)):
        run = record(method, psnr=(psnr,), seconds=seconds, render_seconds=0.1)
        folder = tmp_path / f"runs/plaza/{method}-joint-fast/seed0"
        folder.mkdir(parents=True)
        write_run(folder, run, rows_of(run))
    (tmp_path / "runs/plaza/quick-joint-fast/seed0/curve.csv").write_text(CURVE)
    return tmp_path / "runs"


@pytest.fixture
def undrawn(monkeypatch):
    """Figures take seconds."""
    monkeypatch.setattr("chronoscene.cli.report.tradeoff.draw", lambda *arguments: None)


tradeoff = partial(invoke, "tradeoff")


@pytest.mark.parametrize("style", FORMATS)
def test_every_format_has_the_fronts(runs, undrawn, style):
    result = tradeoff(runs, "--format", style)
    assert result.exit_code == 0 and "SLOW" in result.stdout
    assert result.stderr.endswith("runs/figures/tradeoff.png\n")


def test_the_figure_goes_where_it_is_wanted(runs, tmp_path):
    assert tradeoff(runs, "--figures", tmp_path / "new").exit_code == 0
    assert (tmp_path / "new/tradeoff.png").stat().st_size > 10_000
    assert not (runs / "figures").exists()


def test_the_terminal_has_times_and_notes(runs, undrawn):
    text = tradeoff(runs).stdout
    assert "plaza: PSNR [dB] of the probe views after so much training on cpu (Test" in text
    assert "device: cpu (Test, 2 threads)" in text and "code: abc" in text
    assert "tie" not in text


def test_csv_and_json_parse_back(runs, undrawn):
    lines = list(csv.DictReader(io.StringIO(tradeoff(runs, "--format", "csv").stdout)))
    document = json.loads(tradeoff(runs, "--format", "json").stdout)
    for line, point in zip(lines, document["fronts"], strict=True):
        assert (line["method"], float(line["quality"])) == (point["method"], point["quality"])
        assert line["on_front"] == str(point["on_front"])
    assert {t["label"] for t in document["times"]} == {"QUICK (joint, fast)"}
    assert "code: abc" in document["notes"]


def test_infinite_values_are_strings_in_json(runs, undrawn):
    folder = runs / "plaza/exact-joint-fast/seed0"
    folder.mkdir(parents=True)
    run = record("exact", psnr=(float("inf"),), render_seconds=0.1)
    write_run(folder, run, rows_of(run))
    text = tradeoff(runs, "--format", "json").stdout
    document = json.loads(text, parse_constant=lambda c: pytest.fail(f"{c} is not JSON"))
    assert "Infinity" in {point["quality"] for point in document["fronts"]}


def test_limits_give_one_sentence_and_nothing_else(runs):
    result = tradeoff(runs, "--budget", "1m", "--max-bytes", "2MB")
    assert result.stdout.count("\n") == 1 and "QUICK (joint, fast) reaches 20.00" in result.stdout
    assert not (runs / "figures").exists()
    assert "SLOW" in tradeoff(runs, "--target-psnr", 24).stdout
    with pytest.raises(ConfigError, match=r"--budget 2s --target-psnr 24: .*nearest: "):
        tradeoff(runs, "--budget", "2s", "--target-psnr", 24)


@pytest.mark.parametrize("option", [("--format", "csv"), ("--figures", "new")])
def test_options_of_what_limits_leave_out_are_refused(runs, option):
    with pytest.raises(ConfigError, match=f"{option[0]}: expected no such option with --budget"):
        tradeoff(runs, "--budget", "1m", *option)


def test_widths_are_not_compared(runs, undrawn):
    folder = runs / "plaza/quick-joint-fast/seed1"
    folder.mkdir()
    run = record("quick", 1, psnr=(21.0,), max_width=800, render_seconds=0.1)
    write_run(folder, run, rows_of(run))
    text = tradeoff(runs).stdout
    assert "QUICK (joint, fast, max_width=800)" in text
    assert "plaza [width 800]: Pareto fronts" in text
    assert "runs with different --max-width (1600, 800) are not compared" in text
    assert "mean of scenes" not in text
    chosen = tradeoff(runs, "--budget", "1m").stdout.splitlines()
    assert [line.partition(",")[0] for line in chosen] == [
        "plaza [width 1600]",
        "plaza [width 800]",
    ]
    assert "--max-width" not in chosen[0] and chosen[1].endswith("--max-width 800")


@pytest.mark.parametrize(("text", "size"), [("500kB", 5e5), ("10MB", 1e7), ("1.5 GB", 1.5e9)])
def test_sizes(text, size):
    assert parse_size(text) == size


@pytest.mark.parametrize("text", ["10", "0MB", "MB", "1TB"])
def test_other_sizes_are_refused(text):
    with pytest.raises(ConfigError, match="--max-bytes: expected a positive size such as 500kB"):
        parse_size(text)
