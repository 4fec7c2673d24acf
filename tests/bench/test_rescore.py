"""Scoring again gives the same numbers, says what changed, and trusts no edited image."""

import json

import numpy as np
import pytest

from chronoscene.bench.image_store import encode_png
from chronoscene.bench.rescore import rescore
from chronoscene.bench.results import Row, read_rows, read_run, run_folders, write_run
from chronoscene.errors import CheckpointError
from chronoscene.metrics.scorers import Scorers, make_scorers

JOINT = "ring/mean-joint-balanced/seed0"


@pytest.fixture
def scorers():
    return make_scorers(["psnr", "ssim", "ssim_valid"])


def test_scoring_again_changes_nothing(runs, scorers):
    before = {p: p.read_bytes() for p in runs.rglob("rows.csv")}
    records = [read_run(p) for p in run_folders(runs)]
    told = []
    outcomes = rescore(runs, scorers, progress=lambda done, total: told.append((done, total)))
    assert len(outcomes) == 4 and told == [(done, 4) for done in range(4)]
    assert all(not o.changes and o.error is None for o in outcomes)
    assert {p: p.read_bytes() for p in runs.rglob("rows.csv")} == before
    for old, folder in zip(records, run_folders(runs), strict=True):
        new = read_run(folder)
        assert (new.aggregates, new.periods) == (old.aggregates, old.periods)
        assert (new.seconds, new.peak_memory_bytes) == (old.seconds, old.peak_memory_bytes)


def test_a_corrected_metric_is_told_and_written(runs):
    before = read_run(runs / JOINT).aggregates["macro"]["psnr"]
    outcomes = rescore(runs, Scorers({"psnr": lambda image, reference: 12.5}, {}))
    told = {str(o.folder.relative_to(runs)): o.changes for o in outcomes}
    assert told[JOINT][0] == f"psnr {before:.6g} -> 12.5 (macro)"
    assert any("ssim dropped" in change for change in told[JOINT])
    for folder in run_folders(runs):
        assert read_run(folder).aggregates["worst"] == {"psnr": 12.5}
    document = json.loads((runs / "results.json").read_text())
    assert {run["aggregates"]["micro"]["psnr"] for run in document} == {12.5}
    assert all(
        line.endswith("psnr,12.5")
        for line in (runs / "rows.csv").read_text().split()[1:]
        if "psnr" in line
    )


def test_an_edited_image_is_an_error_for_its_run_only(runs, scorers):
    path = runs / JOINT / "predictions/a/2.png.png"
    path.write_bytes(encode_png(np.zeros((16, 24, 3), np.uint8)))
    before = (runs / JOINT / "run.json").read_bytes()
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, scorers)}
    assert "SHA-256" in outcomes[JOINT].error and "2.png.png" in outcomes[JOINT].error
    assert (runs / JOINT / "run.json").read_bytes() == before
    assert [o.error for name, o in outcomes.items() if name != JOINT] == [None] * 3


def test_edited_ground_truth_is_an_error(runs, scorers):
    path = runs / "ground_truth/ring/b/1.png.png"
    path.write_bytes(path.read_bytes() + b"\0")
    assert all("SHA-256" in o.error for o in rescore(runs, scorers))


def test_metrics_that_this_machine_lacks_keep_their_values(runs, scorers):
    record, rows = read_run(runs / JOINT), read_rows(runs / JOINT)
    rows += [Row(v, p, p, "all", "lpips_vgg", 0.25) for v, p in (("a/2.png", 0), ("b/1.png", 1))]
    for values in (*record.aggregates.values(), *record.periods.values()):
        values["lpips_vgg"] = 0.25
    write_run(runs / JOINT, record, rows)
    lacking = Scorers(scorers.functions, {"lpips_vgg": "no weights"})
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, lacking)}
    assert outcomes[JOINT].kept == ["lpips_vgg"] and outcomes[JOINT].changes == []
    again = read_run(runs / JOINT)
    assert again.aggregates["macro"]["lpips_vgg"] == 0.25 and again.skipped == {}
    assert read_run(runs / "ring/mean-pooled-balanced/seed0").skipped == {"lpips_vgg": "no weights"}


def test_a_folder_without_runs(tmp_path, scorers):
    with pytest.raises(CheckpointError, match="no finished run in it; run bench first"):
        rescore(tmp_path, scorers)
