"""Regions of test views: frozen with their photos, scored apart, old runs included."""

import json
from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import ConfigError, ImageError
from chronoscene.harness.files.ground_truth import ground_truth_folder
from chronoscene.harness.files.predictions import (
    ImageWriter,
    encode_png,
    load_changed,
    read_manifest,
    to_grey,
    write_manifest,
    write_png,
)
from chronoscene.harness.files.records import read_rows, read_run
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.report.summary import in_region, read_runs, summarise
from chronoscene.harness.run.runner import run_bench
from chronoscene.harness.score.regions import change_masks_hash, freeze_change_masks, regions_of
from chronoscene.harness.score.scoring import rescore
from chronoscene.images.truth import truth_place
from chronoscene.metrics.registry import Scorers, make_scorers

JOINT = "ring/mean-joint-balanced/seed0"
VIEWS = {"a/2.png": 0, "b/1.png": 1, "b/2.png": 1}
SHAPE = (16, 24)


@pytest.fixture
def truth(tmp_path):
    """A folder of change masks: left of a column that differs between the views."""
    return write_masks(tmp_path / "truth", dict(zip(VIEWS, (6, 9, 12), strict=True)))


def write_masks(folder, columns):
    for view, column in columns.items():
        values = np.zeros(SHAPE, np.uint8)
        values[:, :column] = 255
        path = folder / truth_place("change", view, 1 - VIEWS[view])
        path.parent.mkdir(parents=True, exist_ok=True)
        Image.fromarray(values).save(path)
    return folder


@pytest.fixture
def scorers():
    return make_scorers(["psnr", "ssim", "ssim_valid"])


def values_of(folder, metric):
    return {(r.view, r.region): r.value for r in read_rows(folder) if r.metric == metric}


def test_regions_are_added_to_old_runs(runs, truth, scorers):
    before = read_run(runs / JOINT)
    freeze_change_masks(runs, truth)
    outcomes = {str(o.folder.relative_to(runs)): o for o in rescore(runs, scorers)}
    assert any(line.startswith("changed: psnr new: ") for line in outcomes[JOINT].changes)
    record = read_run(runs / JOINT)
    assert record.aggregates == before.aggregates and record.periods == before.periods
    assert record.change_masks == change_masks_hash(
        read_manifest(ground_truth_folder(runs, "ring"))
    )
    assert set(record.regions) == {"changed", "invariant"}
    psnr = values_of(runs / JOINT, "psnr")
    for (view, region), value in psnr.items():
        if region == "all":
            share = {"a/2.png": 6, "b/1.png": 9, "b/2.png": 12}[view] / 24
            changed, same = (10 ** (-psnr[view, r] / 10) for r in ("changed", "invariant"))
            mse = share * changed + (1 - share) * same
            assert value == pytest.approx(-10 * np.log10(mse), abs=1e-9)
    mean = np.mean([psnr["b/1.png", "changed"], psnr["b/2.png", "changed"]])
    assert record.regions["changed"]["periods"]["1"]["psnr"] == pytest.approx(mean)
    macro = np.mean([mean, psnr["a/2.png", "changed"]])
    assert record.regions["changed"]["aggregates"]["macro"]["psnr"] == pytest.approx(macro)
    (document,) = [d for d in json.loads((runs / "results.json").read_text())
                   if (d["method"], d["strategy"]) == ("mean", "joint")]  # fmt: skip
    assert document["regions"] == record.regions


def test_a_region_without_a_whole_window_has_no_value_of_that_metric(runs, truth, scorers):
    freeze_change_masks(runs, truth)
    rescore(runs, scorers)
    views = {view for view, region in values_of(runs / JOINT, "ssim_valid") if region == "changed"}
    assert views == {"b/2.png"}  # 12 columns; the window takes 11
    assert "ssim_valid" not in read_run(runs / JOINT).skipped
    regions = read_run(runs / JOINT).regions
    assert "ssim_valid" not in regions["changed"]["periods"]["0"]


def test_other_masks_invalidate_scores_and_no_training(runs, truth, scorers, scene_folder):
    freeze_change_masks(runs, truth)
    rescore(runs, scorers)
    first = read_run(runs / JOINT)
    write_masks(truth, {"a/2.png": 20})
    freeze_change_masks(runs, truth)
    rescore(runs, scorers)
    second = read_run(runs / JOINT)
    assert first.change_masks != second.change_masks and first.aggregates == second.aggregates
    assert first.regions["changed"]["periods"]["0"] != second.regions["changed"]["periods"]["0"]
    assert first.regions["changed"]["periods"]["1"] == second.regions["changed"]["periods"]["1"]
    settings = bench_settings(
        scenes=(scene_folder,), methods=("toy_methods:MEAN",), runs=runs, threads=1
    )
    outcome = run_bench(settings, lambda line: None, execute=lambda job: pytest.fail(job.label))
    assert [str(f.relative_to(runs)) for f in outcome.finished] == [JOINT]


def test_later_runs_are_scored_by_regions_too(bench_here, runs, truth, scene_folder):
    freeze_change_masks(runs, truth)
    outcome, _ = bench_here("toy_methods:MEAN", runs=runs, seeds=(7,), threads=1)
    (folder,) = outcome.finished
    assert {region for _, region in values_of(folder, "psnr")} == {"all", "changed", "invariant"}


def test_metrics_that_are_not_asked_for_keep_their_values(runs, truth, scorers):
    freeze_change_masks(runs, truth)
    rescore(runs, scorers)
    psnr, fitted = values_of(runs / JOINT, "psnr"), make_scorers(["psnr_cc"])
    assert all(o.kept == [] for o in rescore(runs, fitted))
    found = values_of(runs / JOINT, "psnr_cc")
    assert values_of(runs / JOINT, "psnr") == psnr and found.keys() == psnr.keys()
    usual = Scorers(scorers.functions, {}, frozenset({"psnr_cc"}))
    assert all(not o.changes for o in rescore(runs, usual))
    assert values_of(runs / JOINT, "psnr_cc") == found
    write_masks(truth, {"a/2.png": 20})
    freeze_change_masks(runs, truth)
    rescore(runs, usual)  # what was measured in other regions is gone
    assert {region for _, region in values_of(runs / JOINT, "psnr_cc")} == {"all"}


def test_an_edited_mask_is_an_error(runs, truth, scorers):
    freeze_change_masks(runs, truth)
    (runs / "ground_truth/ring/a/2.png.changed.png").write_bytes(
        encode_png(np.zeros(SHAPE, np.uint8))
    )
    assert all("SHA-256" in o.error for o in rescore(runs, scorers))


def test_views_without_masks_and_folders_of_scenes(runs, truth, tmp_path):
    frozen = ground_truth_folder(runs, "ring")
    (truth / truth_place("change", "b/1.png", 0)).unlink()
    (tmp_path / "scenes/ring").mkdir(parents=True)
    truth.rename(tmp_path / "scenes/ring/gt")
    freeze_change_masks(runs, tmp_path / "scenes")
    entries = {e.view: e for e in read_manifest(frozen).images}
    assert load_changed(frozen, entries["b/1.png"]) is None
    assert load_changed(frozen, entries["a/2.png"]).mean() == 6 / 24
    with pytest.raises(ConfigError, match=r"--truth .*: expected change masks of test views"):
        freeze_change_masks(runs, tmp_path)
    assert [e.changed_file for e in read_manifest(frozen).images] == [
        e.changed_file for e in entries.values()
    ]


def test_views_that_share_a_mask_are_refused(runs, truth):
    frozen = ground_truth_folder(runs, "ring")
    manifest = read_manifest(frozen)
    renamed = [e.model_copy(update={"view": e.view.replace("2.", "1.j")}) for e in manifest.images]
    write_manifest(frozen, manifest.model_copy(update={"images": tuple(renamed)}))
    with pytest.raises(ImageError, match="share their files here; rename one of the two images"):
        freeze_change_masks(runs, truth)
    assert not list(frozen.rglob("*.changed.png"))


def test_what_the_mask_of_a_photo_ignores_is_in_no_region(tmp_path):
    image = np.zeros((2, 3, 3), np.uint8)
    mask = np.array([[True, True, False], [False, True, True]])
    changed = np.array([[True, False, True], [False, False, False]])
    writer = ImageWriter(tmp_path)
    writer.add("x.png", image, camera_period=0, rendered_period=0, mask=mask)
    writer.close(kind="ground truth", scene="s", scene_hash="h", details={})
    (entry,) = read_manifest(tmp_path).images
    assert [name for name, _ in regions_of(tmp_path, entry)] == ["all"]
    digest = write_png(tmp_path, "c.png", to_grey(changed))
    entry = entry.model_copy(update={"changed_file": "c.png", "changed_sha256": digest})
    regions = dict(regions_of(tmp_path, entry))
    np.testing.assert_array_equal(regions["all"], mask)
    np.testing.assert_array_equal(regions["changed"], mask & changed)
    np.testing.assert_array_equal(regions["invariant"], mask & ~changed)


def test_tables_of_a_region(runs, truth, scorers):
    freeze_change_masks(runs, truth)
    rescore(runs, scorers)
    records, _ = read_runs([runs])
    changed = in_region(records, "changed")
    assert {run.scene for run in changed} == {"ring (changed)"} and len(changed) == len(records)
    entries = summarise(changed, ["psnr"]).query("column == 'macro' and strategy == 'joint'")
    psnr = {run.method: run.regions["changed"]["aggregates"]["macro"]["psnr"]
            for run in records if run.strategy == "joint"}  # fmt: skip
    assert dict(zip(entries.method, entries["mean"], strict=True)) == psnr
    for run, whole in zip(changed, records, strict=True):
        expected = [row for row in whole.rows if row.region == "changed"]
        assert [replace(row, region="changed") for row in run.rows] == expected != []


def test_a_region_that_was_not_scored(runs):
    with pytest.raises(
        ConfigError, match=r"--region changed: .* found none; run chronoscene score"
    ):
        in_region(read_runs([runs])[0], "changed")
