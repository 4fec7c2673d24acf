"""A bench that is killed or interrupted loses nothing finished and leaves nothing half done."""

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from waiting import wait_for

from chronoscene.harness.files.records import read_run, run_folders
from chronoscene.io.processes import process_tree

SCRIPT = """
import sys
from pathlib import Path
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.runner import run_bench
run_bench(
    bench_settings(
        scenes=(Path(sys.argv[1]),),
        methods=(sys.argv[3] if len(sys.argv) > 3 else "toy_methods:MEAN",),
        runs=Path(sys.argv[2]),
        threads=1,
        seeds=(0, 1),
        iterations=20,
        overrides=dict(o.split("=") for o in sys.argv[4:]),
        overwrite=True,
    ),
    lambda line: print(line, flush=True),
)
"""


def workers_of(pid):
    path = Path(f"/proc/{pid}/task/{pid}/children")
    return [int(child) for child in path.read_text().split()] if path.exists() else []


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_a_killed_bench_keeps_what_is_finished_and_goes_on(
    bench_here, scene_folder, tmp_path, monkeypatch
):
    runs, hold = tmp_path / "runs", tmp_path / "hold"
    hold.touch()
    monkeypatch.setenv("TOY_HOLD", f"1:{hold}")
    command = [sys.executable, "-c", SCRIPT, str(scene_folder), str(runs)]
    done = runs / "ring/mean-joint-balanced/seed0/run.json"
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        wait_for(done.is_file)
        before = done.read_bytes()
        half_done = wait_for(lambda: list(runs.glob("ring/*/.seed1.*.partial/config.json")))
        (worker,) = workers_of(process.pid)
    finally:
        process.send_signal(signal.SIGKILL)
        process.wait()
    # The worker notices that its bench is gone; it must not write into the next one's folder.
    wait_for(lambda: not Path(f"/proc/{worker}").exists())
    assert half_done[0].parent.exists()
    hold.unlink()
    _, said = bench_here("MEAN", threads=1, seeds=(0, 1), iterations=20, overwrite=True)
    assert "1 of 2 runs are finished and kept" in said
    assert done.read_bytes() == before
    assert [p.name for p in run_folders(runs)] == ["seed0", "seed1"]
    assert not list(runs.rglob("*.partial"))
    a, b = (read_run(p) for p in run_folders(runs))
    assert a.aggregates == b.aggregates and a.config_hash == b.config_hash


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_an_interrupted_bench_leaves_no_process_and_no_half_run(
    number, scene_folder, tmp_path, monkeypatch
):
    runs = tmp_path / "runs"
    monkeypatch.setenv("TOY_HOLD", f"0:{scene_folder}")  # for ever
    command = [sys.executable, "-c", SCRIPT, str(scene_folder), str(runs)]
    process = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell starts jobs in the background with Ctrl-C ignored, and children inherit that.
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),
    )
    wait_for(lambda: list(runs.glob("ring/*/.seed0.*.partial/config.json")))
    (worker,) = workers_of(process.pid)
    if number == signal.SIGINT:
        os.killpg(process.pid, number)  # what Ctrl-C does
    else:
        process.send_signal(number)  # what a batch system does
    _, errors = process.communicate(timeout=120)
    assert process.returncode != 0
    assert "stack trace" not in errors
    assert not Path(f"/proc/{worker}").exists()
    assert not list(runs.rglob("*.partial"))
    assert not (runs / "results.json").exists()


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "number", [pytest.param(signal.SIGTERM, marks=pytest.mark.slow), signal.SIGKILL]
)
def test_a_program_that_a_bench_runs_ends_with_it(number, scene_folder, tmp_path):
    """It is in a session of its own; after SIGKILL, the worker notices that its bench is gone."""
    runs, hold = tmp_path / "runs", tmp_path / "hold"
    hold.touch()
    arguments = [str(scene_folder), str(runs), "toy_programs:PROGRAM", f"hold={hold}"]
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, *arguments])
    try:
        (log,) = wait_for(lambda: list(runs.glob("ring/*/.seed0.*.partial/program.log")))
        wait_for(lambda: "training 20" in log.read_text())
        started = process_tree([process.pid])
        assert len(started) == 3  # bench, worker, program
    finally:
        process.send_signal(number)
        process.wait()
    wait_for(lambda: not process_tree(started))
    assert number == signal.SIGKILL or not list(runs.rglob("*.partial"))


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_time_in_which_a_training_is_stopped_is_off_its_clock(scene_folder, tmp_path):
    runs = tmp_path / "runs"
    arguments = [str(scene_folder), str(runs), "toy_methods:MEAN", "sleep=0.2"]
    process = subprocess.Popen(
        [sys.executable, "-c", SCRIPT, *arguments], stderr=subprocess.PIPE, text=True
    )
    assert any("iteration 6" in line for line in process.stderr)
    (worker,) = workers_of(process.pid)
    time.sleep(0.1)  # the worker may still be at its report; a pause there is on no clock
    os.kill(worker, signal.SIGSTOP)
    time.sleep(4)
    os.kill(worker, signal.SIGCONT)
    process.communicate(timeout=120)
    record = read_run(run_folders(runs)[0])
    assert record.waited_seconds > 3.5
    assert 4.0 < record.seconds < 7.0
