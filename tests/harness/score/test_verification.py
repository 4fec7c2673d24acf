"""Runs are verified from their images; every kind of damage is found at its place."""

import json
import os
import re
import shutil
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.errors import CheckpointError
from chronoscene.harness.files.predictions import encode_png, read_manifest, write_manifest
from chronoscene.harness.files.records import read_rows, read_run, write_run, write_summary
from chronoscene.harness.score.verification import TOLERANCE, differences, verify
from chronoscene.io.staging import sha256_of

JOINT = "ring/mean-joint-balanced/seed0"
VIEW = "a/2.png"


@pytest.fixture
def check(runs):
    """Verify the runs; returns the outcome of one of them, and checks that nothing was written."""

    def tree():
        return {p: (sha256_of(p), p.stat().st_mtime_ns) for p in runs.rglob("*") if p.is_file()}

    def run(folder=JOINT):
        before = tree()
        found = {os.path.relpath(v.label, runs): v for v in verify(runs)}
        assert tree() == before
        others = [v for label, v in found.items() if label.startswith("ring") and label != folder]
        assert len(others) == 3 and all(v.views == 3 for v in others)
        return found[folder], others

    return run


def edit(path, change):
    """Change a JSON document in place."""
    document = json.loads(path.read_text())
    change(document)
    path.write_text(json.dumps(document))


def replace_number(path, metric):
    """Make the first value of a metric in a CSV file larger by 0.5; returns the line."""
    text = path.read_text()
    line = next(line for line in text.splitlines() if f",all,{metric}," in line)
    start, _, value = line.rpartition(",")
    path.write_text(text.replace(line, f"{start},{float(value) + 0.5!r}", 1))


def test_a_good_run_is_ok_to_the_bit(check):
    found, others = check()
    for run in (found, *others):
        assert (run.verdict, run.views, run.largest) == ("ok", 3, 0.0)
        assert set(run.metrics) == {"psnr", "ssim", "ssim_valid"} - run.record.skipped.keys()


def test_a_single_run_is_verified_with_its_line_in_the_summary(runs):
    (found,) = verify(runs / JOINT)
    assert found.verdict == "ok"
    edit(runs / "results.json", lambda d: [r["periods"]["0"].update(psnr=99.0) for r in d])
    (found,) = verify(runs / JOINT)
    assert [text.split(": ")[0] for text in found.differs] == ["results.json"]


def test_an_edited_mean(runs, check):
    edit(runs / JOINT / "run.json", lambda d: d["aggregates"]["macro"].update(psnr=40.0))
    found, others = check()
    assert found.verdict == "differs" and found.largest > 1
    (text,) = found.differs
    assert re.match(r"run\.json: aggregates\.macro\.psnr: expected \d.*, found 40\.0$", text)
    assert all(run.verdict == "ok" for run in others)


def test_an_edited_period_in_the_summary(runs, check):
    number = [r["method"] + r["strategy"] for r in json.loads((runs / "results.json").read_text())]
    at = number.index("meanjoint")
    edit(runs / "results.json", lambda d: d[at]["periods"]["1"].update(psnr=40.0))
    found, others = check()
    (text,) = found.differs
    assert text.startswith("results.json: periods.1.psnr: expected ")
    assert all(run.verdict == "ok" for run in others)


def test_a_summary_by_a_version_with_fewer_fields(runs, check):
    edit(runs / "results.json", lambda d: [r.pop("stages") for r in d])
    found, others = check()
    assert {run.verdict for run in (found, *others)} == {"ok"}


@pytest.mark.parametrize("own", [True, False])
def test_an_edited_row(runs, check, own):
    replace_number((runs / JOINT if own else runs) / "rows.csv", "psnr")
    found, others = check(JOINT)
    changed = [run for run in (found, *others) if run.differs]
    assert len(changed) == 1 and changed[0].largest == pytest.approx(0.5)
    name = "rows.csv" if own else "rows.csv of all runs"
    (text,) = changed[0].differs
    assert text.startswith(f"{name}: psnr of {VIEW} as of period 0, taken in 0, all: expected ")


def test_a_missing_row(runs, check):
    path = runs / JOINT / "rows.csv"
    lines = path.read_text().splitlines(keepends=True)
    path.write_text("".join(lines[:-1]))
    found, _ = check()
    assert found.verdict == "differs" and "found nothing; 1 more in this file" in found.differs[0]


def test_an_edited_prediction(runs, check):
    path = runs / JOINT / f"predictions/{VIEW}.png"
    path.write_bytes(encode_png(np.zeros((16, 24, 3), np.uint8)))
    found, others = check()
    assert found.verdict == "differs" and len(found.differs) == 1
    assert str(path) in found.differs[0] and "found another file" in found.differs[0]
    assert all(run.verdict == "ok" for run in others)


def test_a_prediction_that_was_replaced_together_with_its_hash(runs, check):
    folder = runs / JOINT / "predictions"
    path = folder / f"{VIEW}.png"
    path.write_bytes(encode_png(np.zeros((16, 24, 3), np.uint8)))
    manifest = read_manifest(folder)
    images = [
        image.model_copy(update={"sha256": sha256_of(path)}) if image.view == VIEW else image
        for image in manifest.images
    ]
    write_manifest(folder, manifest.model_copy(update={"images": tuple(images)}))
    found, _ = check()
    places = [text.split(": ")[0] for text in found.differs]
    assert places == ["rows.csv", "run.json", "results.json", "rows.csv of all runs"]
    assert f" of {VIEW} as of" in found.differs[0]


def test_an_edited_photo_is_told_of_every_run(runs, check):
    path = runs / f"ground_truth/ring/{VIEW}.png"
    path.write_bytes(encode_png(np.zeros((16, 24, 3), np.uint8)))
    found, others = check()
    for run in (found, *others):
        assert run.verdict == "differs" and str(path) in run.differs[0]


def test_a_missing_prediction(runs, check):
    path = runs / JOINT / f"predictions/{VIEW}.png"
    path.unlink()
    found, others = check()
    assert found.verdict == "incomplete" and found.differs == []
    assert len(found.absent) == 1 and str(path) in found.absent[0]
    assert all(run.verdict == "ok" for run in others)


@pytest.mark.parametrize(
    ("file", "verdict"),
    [
        ("rows.csv", "incomplete"),
        ("config.json", "incomplete"),
        ("predictions/manifest.json", "incomplete"),
        ("run.json", "gone"),
        ("checkpoint", "incomplete"),
    ],
)
def test_missing_files(runs, file, verdict):
    path = runs / JOINT / file
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    found = [run for run in verify(runs) if run.verdict != "ok"]
    if verdict == "gone":  # only the summary knows of it
        assert found[0].label == f"{runs}/results.json: ring mean joint balanced 0"
        assert found[0].absent == ["no folder of such a run that can be read"]
    else:
        assert found[0].verdict == verdict and file in found[0].absent[0]
        assert len(found[0].absent) == 1


@pytest.mark.parametrize(
    "file", ["run.json", "rows.csv", "config.json", "predictions/manifest.json"]
)
def test_files_that_are_not_what_bench_wrote(runs, file):
    (runs / JOINT / file).write_bytes(b"\xff\xfe\x00{")
    found = {os.path.relpath(v.label, runs): v for v in verify(runs)}
    assert found[JOINT].verdict == "differs" and len(found[JOINT].differs) == 1
    assert str(runs / JOINT / file) in found[JOINT].differs[0]
    assert [v.verdict for v in found.values()].count("ok") == 3


@pytest.mark.parametrize("file", ["results.json", "rows.csv"])
@pytest.mark.parametrize("content", [None, b"\xff["])
def test_a_damaged_summary_is_told_of_every_run(runs, file, content):
    (runs / file).unlink() if content is None else (runs / file).write_bytes(content)
    found = verify(runs)
    assert len(found) == 4
    for run in found:
        (text,) = run.absent if content is None else run.differs
        assert str(runs / file) in text


def test_a_result_without_its_run(runs, check):
    edit(runs / "results.json", lambda d: d.append(d[0] | {"method": "invented"}))
    *found, invented = verify(runs)
    assert all(run.verdict == "ok" for run in found)
    assert invented.verdict == "incomplete" and "invented" in invented.label


def test_the_model_and_the_configuration(runs, check):
    (runs / JOINT / "checkpoint/more").write_bytes(b"123")
    edit(runs / JOINT / "config.json", lambda d: d["config"].update(preset="accurate"))
    found, _ = check()
    config, hashed, model = found.differs
    assert config.startswith("config.json: config_hash: ") or "preset" in config
    assert hashed.startswith("run.json: config_hash: ")
    assert model.startswith("run.json: checkpoint_bytes: ")


def test_the_hash_of_the_model(trained, tmp_path):
    root = shutil.copytree(trained["chronogs"].parents[2], tmp_path / "runs")
    folder = root / trained["chronogs"].relative_to(trained["chronogs"].parents[2])
    assert verify(folder)[0].verdict == "ok"
    path = folder / "checkpoint/model.safetensors"
    data = bytearray(path.read_bytes())
    data[-1] ^= 1
    path.write_bytes(data)
    (found,) = verify(folder)
    (text,) = found.differs
    assert text.startswith(f"{folder}/checkpoint/model.json: tensors_sha256: ")


def test_values_that_cannot_be_computed_here_are_said_to_be_unchecked(runs, monkeypatch):
    folder = runs / JOINT
    monkeypatch.setattr("chronoscene.metrics.registry.find_spec", lambda name: None)
    record, rows = read_run(folder), read_rows(folder)
    more = [replace(row, metric="flip", value=0.5) for row in rows if row.metric == "psnr"]
    for values in (*record.aggregates.values(), *record.periods.values()):
        values["flip"] = 0.5
    write_run(folder, record, [*rows, *more])
    write_summary(runs)
    (found,) = verify(folder)
    assert found.verdict == "ok" and "flip" not in found.metrics
    assert "flip_evaluator" in found.unchecked["flip"]
    edit(folder / "run.json", lambda d: d["aggregates"]["macro"].update(flip=0.4))
    (found,) = verify(folder)
    assert found.differs[0].startswith("run.json: aggregates.macro.flip: ")


def test_a_metric_that_is_not_installed(runs):
    path = runs / JOINT / "rows.csv"
    path.write_text(path.read_text().replace(",psnr,", ",mae,"))
    (found,) = verify(runs / JOINT)
    assert found.verdict == "incomplete" and "'mae'" in found.absent[0]


def test_a_folder_without_runs(tmp_path):
    with pytest.raises(CheckpointError, match="no finished run in it"):
        verify(tmp_path)


@given(st.floats(1e-3, 1e3), st.floats(-1e-5, 1e-5))
def test_numbers_agree_within_the_tolerance(value, step):
    other = value + step
    found = [*differences({"a": [other]}, {"a": [value]})]
    assert bool(found) == (other != value)
    for difference in found:
        assert difference.place == "a[0]"
        limit = TOLERANCE * max(1.0, abs(value), abs(other))
        assert difference.agrees == (abs(other - value) <= limit)


@pytest.mark.parametrize(
    ("stored", "computed"),
    [(10**8, 10**8 + 1), ("Infinity", 30.0), (30.0, None), ([1.0], [1.0, 1.0]), ({}, {"a": 1.0})],
)
def test_what_never_agrees(stored, computed):
    (found,) = differences(stored, computed)
    assert not found.agrees


def test_stages(bench_here):
    outcome, _ = bench_here("toy_methods:MEAN", strategies=("sequential",))
    (folder,) = outcome.finished
    (found,) = verify(folder)
    assert (found.verdict, found.largest) == ("ok", 0.0) and found.record.stages
    edit(folder / "run.json", lambda d: d["transfer"]["forgetting"].update(psnr=-9.0))
    (found,) = verify(folder)
    assert found.differs[0].startswith("run.json: transfer.forgetting.psnr: ")
    shutil.rmtree(folder / "stages")
    (found,) = verify(folder)
    assert found.verdict == "incomplete" and str(folder / "stages") in found.absent[0]
