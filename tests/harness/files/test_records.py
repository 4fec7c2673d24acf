"""Run records survive JSON, also with infinite values; damaged ones are named."""

import csv
import json
import math
import shutil
from pathlib import Path
from threading import Thread

import pytest
from made_runs import write_scored

from chronoscene.errors import CheckpointError
from chronoscene.harness.files import records
from chronoscene.harness.files.records import (
    Failure,
    ViewScore,
    no_runs,
    read_rows,
    read_run,
    run_folders,
    write_failure,
    write_run,
    write_summary,
    write_summary_of_readable,
)

JOINT = "ring/mean-joint-balanced/seed0"


def refuse(constant):
    raise AssertionError(f"{constant} is not JSON")


def test_infinite_psnr_is_plain_json(runs):
    record = read_run(runs / JOINT)
    record.aggregates["macro"]["psnr"] = math.inf
    rows = [ViewScore("a/2.png", 0, 0, "all", "psnr", math.inf)]
    write_run(runs / JOINT, record, rows)
    document = json.loads((runs / JOINT / "run.json").read_text(), parse_constant=refuse)
    assert document["aggregates"]["macro"]["psnr"] == "Infinity"
    assert read_run(runs / JOINT) == record
    assert read_rows(runs / JOINT) == rows
    write_summary(runs)
    json.loads((runs / "results.json").read_text(), parse_constant=refuse)


@pytest.mark.parametrize("field", ["periods", "period_labels"])
def test_a_period_that_is_no_number_is_damage(tmp_path, field):
    path = write_scored(tmp_path) / "run.json"
    document = json.loads(path.read_text())
    document[field]["x"] = document[field]["0"]
    path.write_text(json.dumps(document))
    with pytest.raises(CheckpointError, match=rf"run\.json: expected what .*\({field}\.x"):
        read_run(path.parent)


def test_a_summary_has_the_runs_that_another_command_finishes_meanwhile(runs, monkeypatch):
    others, again = [], runs / JOINT.replace("seed0", "seed1")

    def read(folder):
        if not others:  # the folders are listed by now
            others.append(Thread(target=write_summary, args=[runs]))
            shutil.copytree(runs / JOINT, again)
            others[0].start()
            others[0].join(0.2)
        return read_run(folder)

    monkeypatch.setattr(records, "read_run", read)
    first = write_summary(runs)
    others[0].join()
    assert len(json.loads((runs / "results.json").read_text())) == len(first) + 1


def test_a_summary_reads_each_run_once(runs, monkeypatch):
    read = []
    monkeypatch.setattr(records, "read_run", lambda folder: read.append(folder) or read_run(folder))
    (runs / JOINT / "rows.csv").unlink()
    assert [*write_summary_of_readable(runs)] == [runs / JOINT]
    assert read == run_folders(runs) and len(json.loads((runs / "results.json").read_text())) == 3


def test_the_summary_is_made_from_the_runs_alone(runs):
    before = (runs / "results.json").read_text(), (runs / "rows.csv").read_text()
    (runs / "results.json").unlink()
    (runs / "rows.csv").unlink()
    assert [r.strategy for r in write_summary(runs)] == ["pooled", "joint", "pooled", "separate"]
    assert ((runs / "results.json").read_text(), (runs / "rows.csv").read_text()) == before


def test_half_written_runs_are_not_runs(runs):
    (runs / JOINT).rename((runs / JOINT).with_name(".seed0.77.partial"))
    assert len(run_folders(runs)) == 3


@pytest.mark.parametrize(
    ("named", "meant"),
    [("RUNS/ring", "RUNS"), (f"RUNS/{JOINT}/..", "RUNS"), (f"RUNS/{JOINT}", "RUNS"), (".", "RUNS"),
     ("RUNS/ground_truth", None)],
)  # fmt: skip
def test_the_folder_of_runs_is_named_where_it_is_near(runs, monkeypatch, named, meant):
    runs.rename(runs.with_name("RUNS"))
    monkeypatch.chdir(runs.parent)
    message = str(no_runs(Path(named)))
    assert "expected a folder of runs, with SCENE/METHOD/seed0 in it, found no run" in message
    assert message.endswith(f"name {meant}" if meant else "run bench first")


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda d: d.pop("seconds"), "Field required .seconds"),
        (lambda d: d.update(seed="first"), "seed"),
        (lambda d: d.update(surprise=1), "surprise"),
    ],
)
def test_damaged_records_are_named(runs, edit, message):
    path = runs / JOINT / "run.json"
    document = json.loads(path.read_text())
    edit(document)
    path.write_text(json.dumps(document))
    with pytest.raises(CheckpointError, match=message):
        read_run(runs / JOINT)


def test_damaged_rows_are_named(runs):
    path = runs / JOINT / "rows.csv"
    path.write_text(path.read_text().replace(",all,psnr,", ",all,psnr,many"))
    with pytest.raises(CheckpointError, match=r"rows\.csv: expected the rows of a run"):
        read_rows(runs / JOINT)


def test_missing_runs_are_named(tmp_path):
    with pytest.raises(CheckpointError, match="no such file; run bench first"):
        read_run(tmp_path)
    failed, done = tmp_path / "plaza/3dgs/seed0", tmp_path / "plaza/4dgs/seed0"
    failed.mkdir(parents=True)
    failure = {"method": "3dgs", "strategy": "", "preset": "", "scene": "plaza", "seed": 0}
    write_failure(failed, Failure(**failure, reason="out of memory"))
    with pytest.raises(CheckpointError, match="found a run that failed: out of memory; run bench"):
        read_run(failed)
    done.mkdir(parents=True)
    (done / "run.json").touch()
    for folder in (tmp_path, tmp_path / "plaza", done.parent):
        with pytest.raises(CheckpointError, match=f"a folder of runs; name .* such as {done}$"):
            read_run(folder)
    with pytest.raises(CheckpointError, match=f"a file in place of the folder; name {done}$"):
        read_run(done / "run.json")


def test_all_keys_and_columns_are_in_the_documentation(finished_bench):
    runs = finished_bench[0]
    text = (Path(__file__).parents[3] / "docs/reference/results.md").read_text(encoding="utf-8")
    documents = json.loads((runs / "results.json").read_text())
    keys = {key for document in documents for key in (*document, *document["aggregates"])}
    with (runs / "rows.csv").open(newline="") as file:
        keys |= {*next(csv.reader(file))}
    for path in runs.glob("*/*/seed0/curve.csv"):
        keys |= {*path.read_text().splitlines()[0].split(",")}
    missing = {key for key in keys if f"`{key}`" not in text}
    assert not missing
