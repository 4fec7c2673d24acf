"""Several runs at a time on this machine."""

import os
import signal
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import psutil
import pytest
from waiting import wait_for

from chronoscene.errors import DiskFullError
from chronoscene.harness.files.records import read_run
from chronoscene.harness.run import local_pool
from chronoscene.io.processes import process_tree

from ..plan.test_job import JOB

FILES = ("checkpoint/model.json", "predictions/manifest.json", "rows.csv", "source.json")


def test_results_do_not_depend_on_how_many_run_at_a_time(bench, bench_here, tmp_path):
    one, _ = bench_here("DRAWING", seeds=(0, 1), runs=tmp_path / "one", threads=1)
    two, said = bench("DRAWING", seeds=(0, 1), runs=tmp_path / "two", jobs=2)
    assert two.failures == () and [f.name for f in two.finished] == ["seed0", "seed1"]
    for a, b in zip(one.finished, two.finished, strict=True):
        assert [(a / file).read_bytes() for file in FILES] == [
            (b / file).read_bytes() for file in FILES
        ]
        assert read_run(a).aggregates == read_run(b).aggregates
    assert sorted(line[:5] for line in said if line.startswith("[")) == ["[1/2]", "[2/2]"]
    assert said[-1].startswith("2 of 2 runs, 0 under way, ")
    assert said[-1].endswith(" runs/h, 0:00 left")


@pytest.mark.slow
def test_a_full_disk_ends_all_runs(bench, tmp_path):
    with pytest.raises(DiskFullError, match=r"full-disk-joint-balanced/seed0: expected space for"):
        bench("MEAN", "FULL_DISK", jobs=2, overrides={"mean.sleep": "60"})
    assert not list(tmp_path.rglob("*.partial")) and not list(tmp_path.rglob("failed.json"))
    commands = [psutil.Process(pid).cmdline() for pid in process_tree([os.getpid()])]
    assert not [words for words in commands if "chronoscene.harness.train.worker:execute" in words]


@pytest.fixture
def run_pool(monkeypatch):
    """Runs two jobs of so many bytes, with so many free; returns how they ran.

    The first one goes on until the other one has begun, or has said that it waits.
    """

    def run(memory, free):
        together, most, seen, notes = set(), 0, [], []
        other = threading.Event()

        def work(job, *, report, stop):
            nonlocal most
            together.add(job.seed)
            most = max(most, len(together))
            if most == 2:
                other.set()
            assert other.wait(60)
            together.discard(job.seed)
            seen.append((job.settings.threads, job.reports))

        monkeypatch.setattr(local_pool, "run_in_process", work)
        monkeypatch.setattr(local_pool, "machine_memory", lambda: (10**10, free))
        monkeypatch.setattr(local_pool, "available_threads", lambda: 9)
        monkeypatch.setattr(local_pool, "PATIENCE", 0.01)
        local = local_pool.LocalPool(2)
        jobs = [replace(JOB, seed=seed, memory=memory) for seed in (0, 1)]

        def report(what, done, total):
            notes.append(what)
            other.set()

        with ThreadPoolExecutor(2) as threads:
            list(threads.map(lambda job: local.run(job, report), jobs))
        return most, seen, notes

    return run


def test_runs_begin_when_their_memory_is_free(run_pool):
    most, seen, notes = run_pool(2 * 10**9, 5 * 10**9)
    assert (most, seen, notes) == (2, [(4, True)] * 2, [])
    most, seen, notes = run_pool(3 * 10**9, 5 * 10**9)
    assert most == 1 and len(seen) == 2
    assert [note.partition(": ")[2].partition(": ")[2] for note in notes] == [
        "waits until 3.00 GB of memory are free"
    ]


def test_equal_runs_of_two_folders_go_on_side_by_side(monkeypatch):
    """As of two trials of a search that have drawn the same."""
    both = threading.Barrier(2, timeout=60)
    monkeypatch.setattr(local_pool, "run_in_process", lambda job, **options: both.wait())
    local = local_pool.LocalPool(2)
    jobs = [JOB.with_settings(runs=Path(name)) for name in ("/one", "/two")]
    with ThreadPoolExecutor(2) as threads:
        assert sorted(threads.map(lambda job: local.run(job, print), jobs)) == [0, 1]


def test_a_run_that_is_alone_begins_without_memory(run_pool):
    most, seen, _ = run_pool(10**12, 10**6)
    assert most == 1 and len(seen) == 2


SCRIPT = """
import sys
from pathlib import Path
from chronoscene.harness.plan.settings import bench_settings
from chronoscene.harness.run.runner import run_bench
settings = bench_settings(
    (Path(sys.argv[1]),), ("toy_methods:MEAN", "toy_methods:BLIND"), Path(sys.argv[2]), jobs=2
)
run_bench(settings, print)
"""


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
@pytest.mark.parametrize(
    "number", [signal.SIGTERM, pytest.param(signal.SIGKILL, marks=pytest.mark.slow)]
)
@pytest.mark.slow
def test_all_runs_end_with_their_bench(number, scene_folder, tmp_path, monkeypatch):
    runs = tmp_path / "runs"
    monkeypatch.setenv("TOY_HOLD", f"0:{scene_folder}")  # for ever
    process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(scene_folder), str(runs)])
    try:
        wait_for(lambda: len(list(runs.glob("ring/*/.seed0.*.partial/config.json"))) == 2)
        started = process_tree([process.pid])
        assert len(started) == 3
    finally:
        process.send_signal(number)
        process.wait(60)
    wait_for(lambda: not process_tree(started), seconds=10.0)
    assert len(list(runs.rglob("*.partial"))) == (2 if number == signal.SIGKILL else 0)
