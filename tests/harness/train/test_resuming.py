"""Benches that are killed go on where they were; finished runs are trained further."""

import csv
import json
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from chronoscene.errors import ConfigError
from chronoscene.harness.files.records import read_run
from chronoscene.harness.train import worker
from chronoscene.harness.train.checkpoints import Checkpoints
from chronoscene.methods import load_spec, method_names

TOY = "toy_methods:DRAWING"
SCRIPT = """
import sys
from pathlib import Path
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.runner import run_bench
run_bench(
    bench_settings(
        scenes=(Path(sys.argv[1]),),
        methods=(sys.argv[2],),
        runs=Path(sys.argv[3]),
        threads=1,
        iterations=int(sys.argv[4]),
        preset=sys.argv[5],
        checkpoint_seconds=0.03,
        strategies=(sys.argv[6],),
    ),
    lambda line: print(line, flush=True),
)
"""


def start(scene, method, runs, iterations, preset="balanced", strategy="joint"):
    arguments = [str(scene), method, str(runs), str(iterations), preset, strategy]
    return subprocess.Popen([sys.executable, "-c", SCRIPT, *arguments], stderr=subprocess.PIPE)


def run_of(runs):
    """The run that was made last."""
    folders = [path.parent for path in runs.glob("ring/*/seed0/run.json")]
    return max(folders, key=lambda folder: (folder / "run.json").stat().st_mtime_ns)


def outcome(runs):
    """Everything of a run that does not depend on the time that it took."""
    folder = run_of(runs)
    found = {}
    for name in ("checkpoint", "predictions", "stages"):
        for path in sorted((folder / name).rglob("*")):
            found[str(path.relative_to(folder))] = path.read_bytes() if path.is_file() else None
    with (folder / "curve.csv").open(newline="") as file:
        found["curve"] = [{**line, "seconds": ""} for line in csv.DictReader(file)]
    found["scores"] = read_run(folder).aggregates
    return found


def checkpoint_of(runs, part="all"):
    """Iterations of the newest checkpoint; 0 before the first."""
    found = [int(p.name) for p in runs.glob(f"ring/*/.seed0.training/{part}/*") if p.name.isdigit()]
    return max(found, default=0)


def kill_later(process, runs, seconds, part="all"):
    """Kill a bench, some time after the next checkpoint; whether it was still running."""
    before = checkpoint_of(runs, part)
    while checkpoint_of(runs, part) in (0, before) and process.poll() is None:
        time.sleep(0.01)
    time.sleep(seconds)
    process.send_signal(signal.SIGKILL)
    process.communicate()  # ends with the worker, which holds the pipe
    return process.returncode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("strategy", "part"),
    [pytest.param("joint", "all", marks=pytest.mark.slow), ("sequential", "period-1")],
)
def test_a_killed_training_ends_as_an_undisturbed_one(
    bench_here, scene_folder, tmp_path, strategy, part
):
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    options = {"iterations": 150, "strategies": (strategy,), "threads": 1}
    bench_here("DRAWING", runs=whole, **options)
    process = start(scene_folder, TOY, killed, 150, "slow", strategy)
    assert kill_later(process, killed, random.Random(1).uniform(0, 0.3), part)
    assert 0 < checkpoint_of(killed, part) < 150
    bench_here("DRAWING", runs=killed, preset="slow", **options)
    assert outcome(killed) == outcome(whole)
    record = read_run(run_of(killed))
    assert (record.resumed, record.iterations) == (1, 150)
    assert not list(killed.glob("ring/*/.*"))


@pytest.mark.parametrize("stage", [0, 1])
def test_a_training_in_stages_that_ends_with_one_goes_on(bench_here, tmp_path, monkeypatch, stage):
    """It dies when the stage is over, before its model is saved."""
    whole, runs = tmp_path / "whole", tmp_path / "runs"
    options = {"strategies": ("sequential",), "preset": "fast", "iterations": 16}
    bench_here("chronogs", runs=whole, **options)
    save = worker._save

    def dying_save(method, checkpoint, part):
        if part.name == f"period-{stage}":
            raise SystemExit
        return save(method, checkpoint, part)

    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(worker, "_save", dying_save)
        bench_here("chronogs", runs=runs, **options)
    bench_here("chronogs", runs=runs, **options)
    assert read_run(run_of(runs)).resumed == 1
    assert outcome(runs) == outcome(whole)
    assert not list(runs.glob("ring/*/.*"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "method", [name for name in method_names() if not load_spec(name).mixes_views]
)
def test_a_training_that_is_killed_again_and_again(scene_folder, tmp_path, method):
    generator = random.Random(2)
    assert start(scene_folder, method, tmp_path / "whole", 1500, "fast").communicate()
    runs, kills = tmp_path / "killed", 0
    while kill_later(
        start(scene_folder, method, runs, 1500, "fast"), runs, generator.uniform(0, 0.5)
    ):
        kills += 1
    print(f"{method}: {kills} kills")
    assert kills >= 3
    assert outcome(runs) == outcome(tmp_path / "whole")


def test_an_unfinished_training_is_not_given_up_for_other_settings(
    bench_here, tmp_path, monkeypatch
):
    runs = tmp_path / "runs"
    options = {"iterations": 20, "preset": "slow", "checkpoint_seconds": 0.0}
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "finish", dying)
        with pytest.raises(SystemExit):
            bench_here(TOY, **options)
    with pytest.raises(ConfigError, match="with device cpu, found an unfinished"):
        bench_here(TOY, **options, device="cpu")
    assert checkpoint_of(runs)
    bench_here(TOY, **options, device="cpu", overwrite=True)
    assert read_run(run_of(runs)).resumed == 0
    assert not list(runs.glob("ring/*/.*"))


def dying(*args):
    raise SystemExit


def test_a_training_on_two_devices_names_both(bench_here, tmp_path, monkeypatch):
    options = {"iterations": 20, "preset": "slow", "checkpoint_seconds": 0.0}
    with monkeypatch.context() as patch, pytest.raises(SystemExit):
        patch.setattr(Checkpoints, "finish", dying)
        patch.setattr(worker, "describe_device", lambda *machine: "cpu (Old, 1 thread)")
        bench_here(TOY, **options)
    monkeypatch.setattr(worker, "describe_device", lambda *machine: "cpu (New, 8 threads)")
    bench_here(TOY, **options)
    record = read_run(run_of(tmp_path / "runs"))
    assert (record.resumed, record.iterations) == (1, 20)
    assert record.device == "cpu (Old, 1 thread); cpu (New, 8 threads)"


def test_what_is_left_of_deleted_checkpoints_is_not_gone_on_from(bench_here, tmp_path, monkeypatch):
    options = {"iterations": 20, "preset": "slow", "checkpoint_seconds": 0.0}
    with monkeypatch.context() as patch:
        patch.setattr(Checkpoints, "finish", dying)
        with pytest.raises(SystemExit):
            bench_here(TOY, **options)
    (settings,) = tmp_path.glob("runs/ring/*/.seed0.training/config.json")
    settings.unlink()
    assert checkpoint_of(tmp_path / "runs")
    bench_here(TOY, **options, device="cpu")
    assert read_run(run_of(tmp_path / "runs")).resumed == 0


@pytest.mark.parametrize("strategy", ["joint", "separate"])
def test_finished_runs_are_trained_further(bench_here, tmp_path, strategy):
    whole, runs = tmp_path / "whole", tmp_path / "runs"
    options = {"strategies": (strategy,)}
    bench_here(TOY, runs=whole, iterations=42, **options)
    with pytest.raises(ConfigError, match=r"finished run that ended .* at most 42 .*, found none"):
        bench_here(TOY, runs=runs, continue_to=42, **options)
    bench_here(TOY, runs=runs, iterations=20, keep_training=True, **options)
    kept = run_of(runs) / "training"
    parts = ["all"] if strategy == "joint" else ["period-0", "period-1"]
    assert sorted(p.name for p in kept.iterdir() if p.is_dir()) == parts
    for iterations in (30, 42):
        further, _ = bench_here(TOY, runs=runs, continue_to=iterations, **options)
        assert further.failures == () and read_run(run_of(runs)).iterations == iterations
    ours, theirs = outcome(runs), outcome(whole)
    del ours["curve"], theirs["curve"]  # probes are at shares of the length
    assert ours == theirs
    config = json.loads((run_of(runs) / "config.json").read_text())["config"]
    assert config["continued_from"] == [20, 30]
    names = [p.name for p in sorted((runs / "ring").iterdir())]
    variants = ["", "-iterations=20+30", "-iterations=20+30+42"]
    assert names == [f"drawing-{strategy}-balanced{variant}" for variant in variants]
    foreign = runs / "ring/other-external-images/seed0"
    shutil.copytree(run_of(runs), foreign)
    (foreign / "config.json").write_text('{"config": {"method_config": {}}}')
    again, _ = bench_here(TOY, runs=runs, continue_to=42, **options)
    shutil.rmtree(foreign)
    assert again.skipped == 1
    with pytest.raises(ConfigError, match=r"rate=0[.]25.* at most 50 iterations, found none"):
        bench_here(TOY, runs=runs, continue_to=50, overrides={"rate": "0.25"}, **options)
    with pytest.raises(ConfigError, match="at most 19 iterations, found one with 20"):
        bench_here(TOY, runs=runs, continue_to=19, **options)
    with pytest.raises(ConfigError, match="with device cpu, found a finished one"):
        bench_here(TOY, runs=runs, continue_to=50, device="cpu", **options)
    shutil.rmtree(run_of(runs) / "training")
    with pytest.raises(ConfigError, match="that kept its training, found its model alone"):
        bench_here(TOY, runs=runs, continue_to=50, **options)


@pytest.mark.parametrize(("preset", "is_same"), [("paper", True), ("fast", False)])
def test_a_schedule_that_ignores_the_length_ends_alike(bench_here, tmp_path, preset, is_same):
    """Unlike one that is stretched to the length of the training."""
    whole, runs = tmp_path / "whole", tmp_path / "runs"
    bench_here("3dgs", runs=whole, preset=preset, iterations=16)
    bench_here("3dgs", runs=runs, preset=preset, iterations=8, keep_training=True)
    bench_here("3dgs", runs=runs, preset=preset, continue_to=16)
    name = "checkpoint/model.safetensors"
    assert (outcome(runs)[name] == outcome(whole)[name]) is is_same


def test_a_run_that_cannot_be_trained_further_stays_as_it_is(bench_here, tmp_path):
    runs = tmp_path / "runs"
    bench_here(TOY, iterations=20, keep_training=True)
    before = outcome(runs)
    for path in (run_of(runs) / "training/all").glob("*/model.json"):
        path.write_text("{}")
    failed, _ = bench_here(TOY, continue_to=30)
    assert "expected a checkpoint to go on from" in failed.failures[0].reason
    assert outcome(runs) == before
