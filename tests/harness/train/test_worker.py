"""Runs of real methods through the harness, in this process."""

import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from chronoscene.errors import BackendError
from chronoscene.formats import chronoscene as scene_format
from chronoscene.harness.files.records import read_run
from chronoscene.harness.plan import plan, sparse_depths
from chronoscene.harness.report.summary import read_runs
from chronoscene.harness.report.tables import format_runs
from chronoscene.harness.train.worker import pick_device
from chronoscene.methods import load_spec, method_names
from chronoscene.training import photometric
from chronoscene.training.checkpoint import load_tensors

SPLATS = [
    pytest.param(name, marks=pytest.mark.slow if name in ("3dgs-period", "scaffold-gs") else ())
    for name in method_names()
    if not load_spec(name).mixes_views
]
"""Methods that draw one view in a step; two have the code of others, ``3dgs`` for example."""


@pytest.mark.parametrize("method", SPLATS)
def test_a_photo_that_shows_nothing_is_an_empty_step(make_scene, tmp_path, bench_here, method):
    scene = make_scene()
    blind = next(frame for frame in scene.frames if frame.split == "train")
    turned = np.diag([-1.0, 1.0, -1.0, 1.0]) @ blind.cam_from_world
    frames = tuple(replace(f, cam_from_world=turned) if f is blind else f for f in scene.frames)
    folder = scene_format.write(replace(scene, frames=frames), tmp_path / "ring")
    options = {"strategies": ("joint",), "preset": "fast", "iterations": 15}
    outcome, _ = bench_here(method, scenes=(folder,), **options)
    assert outcome.failures == ()
    record = read_run(outcome.finished[0])
    assert (record.iterations, record.empty_steps, record.skipped_steps) == (15, 3, 0)
    assert np.isfinite(record.aggregates["macro"]["psnr"])
    tables = format_runs(*read_runs([tmp_path / "runs"]), "table")
    assert "3 of 15 steps empty: their photos show nothing of the model" in tables


@pytest.mark.parametrize("method", [*SPLATS, pytest.param("clnerf", marks=pytest.mark.slow)])
def test_every_method_learns_one_period_after_the_other(bench_here, method):
    options = {"strategies": ("sequential",), "preset": "fast", "iterations": 16}
    outcome, said = bench_here(method, **options)
    assert outcome.failures == ()
    assert "note: sequential: the stages of a run share the iterations and time" in said
    folder, record = outcome.finished[0], read_run(outcome.finished[0])
    assert (record.strategy, record.iterations) == ("sequential", 16)
    assert {stage: set(periods) for stage, periods in record.stages.items()} == {
        "untrained": {"1"}, "period-0": {"0", "1"}, "period-1": {"0", "1"}
    }  # fmt: skip
    assert record.stages["period-1"] == record.periods
    assert set(record.transfer) == {"forgetting", "backward_transfer", "forward_transfer"}
    assert set(record.transfer["forgetting"]) == set(record.aggregates["macro"])
    models = [folder / "checkpoint" / name for name in ("period-0", "period-1")]
    sizes = [sum(path.stat().st_size for path in model.iterdir()) for model in models]
    assert record.checkpoint_bytes == sizes[1]
    periods = [load_tensors(model)[1]["num_periods"] for model in models]
    assert periods == ([1, 1] if load_spec(method).period_input == "none" else [1, 2])


def test_the_place_of_a_plug_in_is_added_to_the_module_path_once(bench_here):
    bench_here("MEAN", iterations=2)
    before = [*sys.path]
    bench_here("MEAN", seeds=(1,), iterations=2)
    assert str(Path.cwd()) in before and sys.path == before


def test_no_stage_looks_at_later_photos(scene_folder, tmp_path, bench_here):
    models = []
    for k in range(2):
        folder = shutil.copytree(scene_folder, tmp_path / f"{k}/ring")
        for path in (folder / "images/b").glob("*.png") if k else ():
            Image.effect_noise((24, 16), 90).convert("RGB").save(path)
        options = {"preset": "fast", "iterations": 16, "runs": tmp_path / f"runs{k}"}
        outcome, _ = bench_here("3dgs", scenes=(folder,), strategies=("sequential",), **options)
        saved = outcome.finished[0] / "checkpoint"
        files = sorted(saved.glob("*/model.safetensors"))
        models.append([path.read_bytes() for path in files])
    assert models[0][0] == models[1][0] and models[0][1] != models[1][1]


def test_a_scene_with_masks_is_trained_and_scored_by_what_counts(
    scene_folder, tmp_path, bench_here
):
    """The runs of two scenes that differ only where masks ignore them are the same."""
    mask = np.full((16, 24), 255, np.uint8)
    mask[4:9, 3:20] = 0
    results = []
    for k in range(2):
        folder = shutil.copytree(scene_folder, tmp_path / f"{k}/ring")
        for path in sorted((folder / "images").rglob("*.png")):
            pixels = np.array(Image.open(path))
            pixels[mask == 0] = 200 * k
            Image.fromarray(pixels).save(path)
            target = folder / "masks" / path.relative_to(folder / "images").with_suffix(".png.png")
            target.parent.mkdir(parents=True, exist_ok=True)
            values = np.zeros_like(mask) if path.name == "1.png" else mask
            Image.fromarray(values).save(target)
        options = {"preset": "fast", "iterations": 15, "runs": tmp_path / f"runs{k}"}
        outcome, _ = bench_here("3dgs", scenes=(folder,), **options)
        record = read_run(outcome.finished[0])
        assert record.empty_steps > 0  # a/1 is a training image
        assert any("not scored" in n and "'b/1.png'" in n for n in record.notices)
        model = (outcome.finished[0] / "checkpoint/model.safetensors").read_bytes()
        results.append((model, record.aggregates["micro"]["psnr"], record.scene_hash))
        assert len(list((tmp_path / f"runs{k}/ground_truth").rglob("*.mask.png"))) == 3
    assert results[0][0] == results[1][0]
    assert results[0][1] == results[1][1] and results[0][2] != results[1][2]


@pytest.mark.parametrize("changed", ["photo", "time alone"])
def test_a_run_is_recorded_only_with_the_photos_of_its_plan(
    scene_folder, tmp_path, bench_here, monkeypatch, changed
):
    folder = shutil.copytree(scene_folder, tmp_path / "new/ring")
    freeze = plan.freeze_ground_truth

    def change_after(*arguments):
        freeze(*arguments)
        if changed == "photo":
            Image.effect_noise((24, 16), 90).convert("RGB").save(folder / "images/a/0.png")
        os.utime(folder / "images/a/0.png", (1, 1))

    monkeypatch.setattr(plan, "freeze_ground_truth", change_after)
    outcome, _ = bench_here("MEAN", scenes=(folder,), iterations=2)
    assert len(outcome.finished) == (changed != "photo")
    for failure in outcome.failures:
        assert failure.reason == (
            f"{folder}: expected the images, masks and model for which the run was planned, found "
            "changes since then; run the same command again, which plans with the present files"
        )


def poison(monkeypatch, numbers):
    """The gradients of the loss are not finite in these calls."""
    compute, calls = photometric._loss_and_gradient, []

    def poisoned(*args):
        loss, gradient = compute(*args)
        calls.append(1)
        return loss, gradient * np.nan if len(calls) in numbers else gradient

    monkeypatch.setattr(photometric, "_loss_and_gradient", poisoned)


@pytest.mark.parametrize("method", SPLATS)
def test_gradients_that_are_not_finite_cost_their_step_alone(bench_here, monkeypatch, method):
    poison(monkeypatch, (4, 5, 9))
    outcome, _ = bench_here(method, preset="fast", iterations=15)
    record = read_run(outcome.finished[0])
    assert (record.iterations, record.empty_steps, record.skipped_steps) == (15, 0, 3)
    assert "3 of 15 steps skipped: their loss or gradients" in " ".join(record.notices)


def test_a_training_that_diverges_keeps_its_last_good_model(tmp_path, bench_here, monkeypatch):
    poison(monkeypatch, range(8, 100))
    outcome, _ = bench_here("3dgs", preset="fast", iterations=100)
    assert "the model of iteration 7 is kept in checkpoint" in outcome.failures[0].reason
    (kept,) = (tmp_path / "runs").rglob("checkpoint")
    assert all(tensor.isfinite().all() for tensor in load_tensors(kept)[0].values())


def test_a_gpu_without_gsplat_serves_fields(monkeypatch, set_gsplat):
    """Methods with Gaussians take the CPU there, unless the GPU is asked for."""
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    set_gsplat(None)
    assert [pick_device("auto", load_spec(name)) for name in ("clnerf", "3dgs")] == ["cuda", "cpu"]
    assert pick_device("cuda", load_spec("neusc")) == "cuda"
    with pytest.raises(BackendError, match=r"expected version 1\.5 or 1\.6, found none"):
        pick_device("cuda", load_spec("chronogs"))


@pytest.mark.parametrize("observed", [True, False])
def test_a_run_says_where_no_points_hold_its_surfaces(bench_here, monkeypatch, observed):
    monkeypatch.setattr(sparse_depths, "MIN_IMAGES", 1 if observed else 1_000)
    outcome, _ = bench_here("3dgs", preset="fast", iterations=5, overrides={"depth_weight": "0.1"})
    told = "depth_weight had no effect" in " ".join(read_run(outcome.finished[0]).notices)
    assert told != observed
