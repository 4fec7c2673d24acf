"""Stages that are done once, and tasks in a process of their own."""

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from waiting import wait_for

from chronoscene.errors import DiskFullError, RegistrationError
from chronoscene.registration.work_folder import TASKS, Stages, run_task, work_folder


class Counter:
    def __init__(self) -> None:
        self.calls: list[str] = []

    def stage(self, name: str, result: Any = None) -> Any:
        def action() -> tuple[Any, list[str]]:
            self.calls.append(name)
            return result, [f"did {name}"]

        return action


def test_a_stage_is_done_once(tmp_path: Path) -> None:
    counter = Counter()
    for _ in range(2):
        stages = Stages(tmp_path)
        assert stages.run("a", {"x": 1}, counter.stage("a", [1, 2])) == [1, 2]
        assert stages.run("b", None, counter.stage("b")) is None
    assert counter.calls == ["a", "b"]
    assert [e["from_an_earlier_run"] for e in stages.log] == [True, True]
    assert stages.log[0]["remarks"] == ["did a"]


def test_a_change_repeats_all_that_follows(tmp_path: Path) -> None:
    counter = Counter()
    for value in (1, 2):
        stages = Stages(tmp_path)
        stages.run("a", value, counter.stage("a"))
        stages.run("b", None, counter.stage("b"))
    assert counter.calls == ["a", "b", "a", "b"]


def test_a_stage_that_fails_or_is_cut_off_is_repeated(tmp_path: Path) -> None:
    def fails() -> tuple[Any, list[str]]:
        raise RuntimeError("killed")

    with pytest.raises(RuntimeError):
        Stages(tmp_path).run("a", None, fails)
    counter = Counter()
    Stages(tmp_path).run("a", None, counter.stage("a"))
    (tmp_path / "stage-a.json").write_text('{"key": ')
    Stages(tmp_path).run("a", None, counter.stage("a"))
    assert counter.calls == ["a", "a"]


def test_two_runs_do_not_share_a_work_folder(tmp_path: Path) -> None:
    with (
        work_folder(tmp_path / "work"),
        pytest.raises(RegistrationError, match="another registration in it") as caught,
        work_folder(tmp_path / "work", patience=0.2),
    ):
        pass
    assert not hasattr(caught.value, "__notes__")  # it is not this run's to delete
    with work_folder(tmp_path / "work"):
        pass


def test_a_folder_with_other_files_is_no_work_folder(tmp_path: Path) -> None:
    mine = tmp_path / "mine"
    (mine / "photos").mkdir(parents=True)
    with pytest.raises(RegistrationError, match="new or empty work folder"), work_folder(mine):
        pass
    assert [path.name for path in mine.iterdir()] == ["photos"]
    with work_folder(tmp_path / "new"):
        (tmp_path / "new/photos").mkdir()
    with work_folder(tmp_path / "new"):
        pass


def test_a_system_without_locks_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("chronoscene.registration.work_folder.fcntl", None)
    message = "register: expected Linux or macOS, .* found .*; run it in the Windows Subsystem"
    with pytest.raises(RegistrationError, match=message), work_folder(tmp_path / "work"):
        pass
    assert not (tmp_path / "work").exists()


ODD_TASKS = """
import os, sys, time
from chronoscene.errors import RegistrationError

def good(arguments, report):
    report("counting", 1, 2)
    print("noise on stdout")
    os.system("echo noise of a library")
    return {"twice": 2 * arguments["x"]}

def aborts(arguments, report):
    print("Check failed: bad input", file=sys.stderr, flush=True)
    os.abort()

def refuses(arguments, report):
    raise RegistrationError("here", expected="this", found="that", todo="do it")

def breaks(arguments, report):
    raise ZeroDivisionError("a mistake of ours")

def threads(arguments, report):
    return os.environ["OPENBLAS_NUM_THREADS"]

def sleeps(arguments, report):
    with open(arguments["mark"], "w") as file:
        file.write(str(os.getpid()))
    time.sleep(60)
"""


@pytest.fixture(autouse=True)
def odd_tasks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Steps that only this test has, in a module that the child process finds."""
    (tmp_path / "odd_tasks.py").write_text(ODD_TASKS)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    for name in ("good", "aborts", "refuses", "breaks", "threads", "sleeps"):
        monkeypatch.setitem(TASKS, name, f"odd_tasks:{name}")


def test_a_task_gives_its_result_and_reports_its_progress(tmp_path: Path) -> None:
    reported: list[tuple[str, int, int]] = []
    result = run_task("good", {"x": 21}, log=tmp_path / "log", report=lambda *p: reported.append(p))
    assert result == {"twice": 42}
    assert reported == [("counting", 1, 2)]
    assert "noise of a library" in (tmp_path / "log").read_text()


def test_the_matrix_library_of_a_task_starts_no_threads(tmp_path: Path) -> None:
    assert run_task("threads", {}, log=tmp_path / "log") == "1"


@pytest.mark.parametrize(
    ("task", "found"),
    [("aborts", r"signal SIGABRT \(.*bad input"), ("breaks", "exit status 1 .*a mistake of ours")],
)
def test_the_death_of_a_task_is_a_message(tmp_path: Path, task: str, found: str) -> None:
    with pytest.raises(RegistrationError, match=found) as caught:
        run_task(task, {}, log=tmp_path / "log")
    assert "--threads 1" in caught.value.todo and str(tmp_path / "log") in caught.value.todo


def test_the_death_of_a_task_on_a_full_disk_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shutil, "disk_usage", lambda folder: SimpleNamespace(free=250_000))
    with pytest.raises(DiskFullError, match=r"expected space .*, found 0\.2 MB left.*--work"):
        run_task("aborts", {}, log=tmp_path / "log")


def test_a_refusal_of_a_task_is_the_same_refusal(tmp_path: Path) -> None:
    with pytest.raises(RegistrationError, match=r"^here: expected this, found that; do it$"):
        run_task("refuses", {}, log=tmp_path / "log")


def test_a_task_dies_with_the_process_that_asked_for_it(tmp_path: Path) -> None:
    code = (
        "from chronoscene.registration import work_folder\n"
        "from pathlib import Path\n"
        "work_folder.TASKS['sleeps'] = 'odd_tasks:sleeps'\n"
        f"work_folder.run_task('sleeps', {{'mark': {str(tmp_path / 'mark')!r}}}, log=Path('log'))\n"
    )
    parent = subprocess.Popen([sys.executable, "-c", code], cwd=tmp_path)
    mark = tmp_path / "mark"
    wait_for(lambda: mark.exists() and mark.read_text() != "")
    child = int(mark.read_text())
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    wait_for(lambda: not is_alive(child))


def is_alive(process: int) -> bool:
    try:
        state = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0]
    except OSError:
        return False
    return state != "Z"
