"""Other programs: their output is kept, all of their processes are watched and ended."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from waiting import wait_for

from chronoscene.errors import ProgramError
from chronoscene.io.processes import end_processes, process_tree
from chronoscene.io.programs import run_program

pytestmark = pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="needs /proc")


def python(code, *arguments):
    return [sys.executable, "-c", code, *map(str, arguments)]


CHILD = """
import subprocess, sys
subprocess.run([sys.executable, "-c", sys.argv[1]])
"""


def run(command, tmp_path):
    return run_program(command, folder=tmp_path, log=tmp_path / "log.txt")


def test_a_program_runs_in_its_folder_and_its_output_is_kept(tmp_path):
    run(python("import os, sys; print(os.getcwd()); print('warned', file=sys.stderr)"), tmp_path)
    run(python("print('again')"), tmp_path)
    log = (tmp_path / "log.txt").read_text().splitlines()
    assert [line for line in log if not line.startswith("$")] == [str(tmp_path), "warned", "again"]


def test_the_memory_is_that_of_all_processes(tmp_path):
    held = "import time; held = b'x' * 150_000_000; time.sleep(2.0)"
    usage = run(python(CHILD, held), tmp_path)
    assert usage.seconds >= 2.0
    assert usage.peak_memory_bytes > 150_000_000


def test_a_failure_ends_in_the_last_lines_of_the_log(tmp_path):
    code = "import sys; print(*range(20), sep='\\n'); sys.exit('\\x1b[31mno GPU here')"
    message = (
        r"to succeed, found exit status 1; log\.txt ends with: .*19 \| \\x1b\[31mno GPU here; "
    )
    with pytest.raises(ProgramError, match=message):
        run(python(code), tmp_path)
    with pytest.raises(ProgramError, match="signal SIGABRT"):
        run(python("import os; os.abort()"), tmp_path)


def test_what_an_error_leaves_out_is_marked(tmp_path):
    code = f"print('log ' * 200); raise SystemExit(1)  # {'long ' * 40}"
    with pytest.raises(ProgramError, match=r" \.\.\.: expected .* ends with: \.\.\. .*log log; "):
        run(python(code), tmp_path)


def test_a_program_that_is_not_there(tmp_path):
    with pytest.raises(ProgramError, match=r"no-such-program -x: expected .*No such file"):
        run(["no-such-program", "-x"], tmp_path)


def test_what_a_program_leaves_running_is_ended(tmp_path):
    """A process in the background whose parent has ended, which stays in the session."""
    code = "import subprocess, sys; subprocess.Popen(['sleep', '1000']); print('left')"
    run(python(CHILD, code), tmp_path)
    assert not any_sleeps("1000")


def any_sleeps(seconds):
    wanted = f"sleep\0{seconds}\0".encode()
    lines = []
    for entry in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            lines.append(entry.read_bytes())
        except OSError:
            continue
    return wanted in lines


STUBBORN = """
import signal, subprocess, sys, time
signal.signal(signal.SIGTERM, signal.SIG_IGN)
subprocess.Popen(["sleep", "2000"], start_new_session=True)  # a child in another session
time.sleep(3000)
"""


def test_a_tree_that_does_not_heed_sigterm_is_killed():
    process = subprocess.Popen(python(CHILD, STUBBORN), start_new_session=True)
    wait_for(lambda: len(process_tree([process.pid])) == 3)
    end_processes([process.pid], grace=0.5)
    assert process.wait() == -signal.SIGTERM and process_tree([process.pid]) == set()
    assert not any_sleeps("2000")


WORKER = """
import sys
from pathlib import Path
from chronoscene.io.processes import run_worker, stoppable
sys.path.insert(0, {folder!r})
with stoppable():
    run_worker("program_worker:work", {folder!r}, environment={{"PYTHONPATH": {path!r}}})
"""
INNER = """
import sys
from pathlib import Path
from chronoscene.io.programs import run_program
def work(folder, report):
    run_program(["sleep", "4000"], folder=Path(folder), log=Path(folder, "log.txt"))
"""


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_program_ends_with_those_who_wait_for_it(tmp_path, number):
    """Also if nobody had the time to clean up: the worker notices that it is alone."""
    (tmp_path / "program_worker.py").write_text(INNER)
    path = os.pathsep.join(filter(None, [str(tmp_path), os.environ.get("PYTHONPATH")]))
    code = WORKER.format(folder=str(tmp_path), path=path)
    process = subprocess.Popen(python(code), stderr=subprocess.DEVNULL)
    try:
        wait_for(lambda: any_sleeps("4000"))
    finally:
        process.send_signal(number)
        process.wait()
    wait_for(lambda: not any_sleeps("4000"))
