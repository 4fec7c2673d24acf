"""``chronoscene tune`` from the outside: the table, the files, and what bench makes of them."""

import json

import pytest
from training_here import execute_here

from chronoscene.harness.run import local_pool

from .test_bench import IMAGES, TESTS, chronoscene


def test_a_search_and_its_preset(make_scene_folder, tmp_path, runs_here, monkeypatch):
    pytest.importorskip("optuna")
    monkeypatch.setattr(local_pool, "run_in_process", lambda job, **options: execute_here(job))
    scene = make_scene_folder(IMAGES, tests=TESTS, name="place")
    out, runs = tmp_path / "tuned", tmp_path / "runs"
    call = ("tune", "toy_methods:TUNED", scene, "--iterations", 12, "--threads", 1, "--out", out)
    done = chronoscene(*call, "--trials", 1)
    assert done.exit_code == 0, done.stderr
    assert "trial 0:" in done.stderr and "1 of 1 runs" in done.stderr
    assert "PSNR and SSIM on validation views; the first trial is the preset" in done.stdout
    assert "PSNR" in (heads := done.stdout.splitlines()[2]) and "SSIM" in heads
    assert f"wrote {out / 'preset.toml'}" in done.stderr
    more = chronoscene(*call, "--trials", 2)
    assert more.exit_code == 0, more.stderr
    assert "trial 0:" not in more.stderr and "trial 1:" in more.stderr

    done = chronoscene(
        "bench", scene, "--method", "toy_methods:TUNED", "--preset", out / "preset.toml",
        "--threads", 1, "--out", runs,
    )  # fmt: skip
    assert done.exit_code == 0, done.stderr
    (record,) = json.loads((runs / "results.json").read_text())
    assert (record["preset"], record["variant"], record["iterations"]) == ("preset", "", 20)


def test_mistakes_are_one_line(make_scene_folder, tmp_path):
    scene = make_scene_folder(IMAGES, tests=TESTS, name="place")
    done = chronoscene(
        "tune", "toy_methods:MEAN", scene, "--trials", 1, "--out", tmp_path / "tuned"
    )
    assert done.exit_code == 2 and len(done.stderr.splitlines()) == 1
    assert "a method with a search space, found none" in done.stderr
    out = "--trials", 1, "--out", tmp_path / "tuned"
    done = chronoscene("tune", "3dgs", scene, "--photo-memory", 0, *out)
    assert done.exit_code == 2 and "memory for photos: expected at least" in done.stderr
    done = chronoscene("tune", "3dgs", scene, "--trials", 1, "--out", scene / "tuned")
    assert done.exit_code == 2 and "--out" in done.stderr and "Traceback" not in done.stderr
