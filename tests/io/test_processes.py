"""Workers and pools: results, progress, errors, and processes that die."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from functools import partial
from pathlib import Path

import pytest
from waiting import wait_for

from chronoscene.errors import ChronoSceneError, SceneError
from chronoscene.io.processes import Outcome, map_parallel, run_worker, stoppable
from chronoscene.io.staging import replacing


def process_of(item: int) -> tuple[int, int]:
    return item, os.getpid()


def fail_on_two(item: int) -> int:
    if item == 2:
        raise SceneError("place", expected="one", found="two", todo="count again")
    return item


def test_results_come_in_order_from_other_processes():
    results = list(map_parallel(process_of, [3, 1, 2], workers=2))
    assert [item for item, _ in results] == [3, 1, 2]
    assert os.getpid() not in {pid for _, pid in results}


def test_one_item_stays_in_this_process():
    assert list(map_parallel(process_of, [5], workers=4)) == [(5, os.getpid())]
    assert list(map_parallel(process_of, [])) == []


def test_an_error_keeps_its_kind_and_words_on_its_way():
    with pytest.raises(SceneError, match="place: expected one, found two; count again") as caught:
        list(map_parallel(fail_on_two, [1, 2, 3], workers=2))
    assert (caught.value.place, caught.value.todo) == ("place", "count again")


def die_on_two(item: int, *, by: signal.Signals = signal.SIGKILL) -> int:
    if item == 2:
        os.kill(os.getpid(), by)  # as a system does that is out of memory
    return 10 * item


@pytest.mark.parametrize("by", [signal.SIGKILL, signal.SIGTERM])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_process_that_dies_loses_its_item_only(workers, by):
    die = partial(die_on_two, by=by)
    found = list(map_parallel(die, [1, 2, 3], workers=workers, lost=lambda item: -item))
    assert found == [10, -2, 30]


def test_a_process_that_dies_is_an_error_in_one_line():
    with pytest.raises(
        ChronoSceneError, match="2: expected the process to finish, found a process that"
    ):
        list(map_parallel(die_on_two, [1, 2, 3], workers=2))


def test_a_file_in_the_current_folder_is_no_module(tmp_path):
    """As ``cd DATASET && chronoscene validate .`` does it, with a dataset of somebody else."""
    (tmp_path / "multiprocessing.py").write_text("open('executed', 'w')")
    code = (
        "import sys; sys.path.remove('')\n"
        "from chronoscene.io.processes import map_parallel\n"
        "assert list(map_parallel(abs, [1, -2], workers=2)) == [1, 2]"
    )
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, check=True)
    assert not (tmp_path / "executed").exists()


def test_a_request_to_end_cleans_up(tmp_path):
    before = signal.getsignal(signal.SIGTERM)
    with pytest.raises(SystemExit) as end, stoppable(), replacing(tmp_path / "a.txt") as partial:
        partial.write_text("half")
        os.kill(os.getpid(), signal.SIGTERM)
    assert end.value.code == 128 + signal.SIGTERM
    assert list(tmp_path.iterdir()) == []
    assert signal.getsignal(signal.SIGTERM) == before


class Ends:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0)  # here the exit is raised


def test_a_request_to_end_that_comes_in_a_finalizer_is_obeyed(capsys):
    before = sys.unraisablehook
    with pytest.raises(SystemExit) as end, stoppable():
        Ends()
        time.sleep(60)
    assert end.value.code == 128 + signal.SIGTERM and sys.unraisablehook == before
    assert capsys.readouterr().err == ""


JOBS = """
import os, sys, time

def twice(job, report):
    report("counting", 1, 2)
    print("a library prints this")
    return 2 * job["x"]

def dies(job, report):
    os.abort()

def kills(job, report):
    os.kill(os.getpid(), 9)

def sleeps(job, report):
    with open(job["mark"], "w") as file:
        file.write(str(os.getpid()))
    time.sleep(60)

def own_number(item):
    return os.getpid()

def variables(job, report):
    return [os.environ.get(name) for name in job]

def refuses(job, report):
    from chronoscene.errors import SceneError
    raise SceneError("here", expected="this", found="that", todo="do it")
"""


@pytest.fixture
def jobs(tmp_path, monkeypatch):
    (tmp_path / "some_jobs.py").write_text(JOBS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)


def test_a_worker_returns_its_result_and_reports_progress(jobs, tmp_path):
    told = []
    with (tmp_path / "log").open("wb") as log:
        outcome = run_worker(
            "some_jobs:twice", {"x": 21}, report=lambda *p: told.append(p), log=log
        )
    assert outcome == Outcome(0, {"result": 42})
    assert told == [("counting", 1, 2)]
    assert (tmp_path / "log").read_text() == "a library prints this\n"


def test_a_worker_has_its_own_variables_besides_ours(jobs, monkeypatch):
    monkeypatch.setenv("OURS", "a")
    found = run_worker("some_jobs:variables", ["OURS", "ITS"], environment={"ITS": "b"})
    assert found.message == {"result": ["a", "b"]}
    assert "ITS" not in os.environ


@pytest.mark.parametrize(
    ("name", "cause"),
    [
        ("dies", "signal SIGABRT"),
        ("kills", "signal SIGKILL (out of memory?)"),
        ("absent", "exit status 1"),
    ],
)
def test_a_worker_that_dies_says_how(jobs, tmp_path, name, cause):
    with (tmp_path / "log").open("wb") as log:
        outcome = run_worker(f"some_jobs:{name}", {}, log=log)
    assert outcome.message is None and outcome.cause == cause


def test_an_error_of_a_worker_comes_back_in_its_words(jobs):
    words = {"place": "here", "expected": "this", "found": "that", "todo": "do it"}
    message = run_worker("some_jobs:refuses", {}).message
    assert message == {"error": words}


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_a_worker_ends_with_its_parent_even_if_that_is_killed(jobs, tmp_path):
    mark = tmp_path / "mark"
    code = (
        "from chronoscene.io.processes import run_worker\n"
        f"run_worker('some_jobs:sleeps', {{'mark': {str(mark)!r}}})\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code])
    wait_for(lambda: mark.exists() and mark.read_text() != "")
    worker = int(mark.read_text())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_for(lambda: not Path(f"/proc/{worker}").exists())


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")
def test_a_pool_ends_with_its_parent_even_if_that_is_killed(jobs):
    """Its processes would wait for items for ever."""
    code = (
        "import time\n"
        "from chronoscene.io.processes import map_parallel\n"
        "from some_jobs import own_number\n"
        "results = map_parallel(own_number, [1, 2, 3], workers=2)\n"
        "print(next(results), flush=True)\n"
        "time.sleep(60)\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True)
    worker = int(parent.stdout.readline())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_for(lambda: not Path(f"/proc/{worker}").exists())
