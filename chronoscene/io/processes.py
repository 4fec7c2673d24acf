"""Work in other processes: one worker for a long job, or a pool for the same task on many items.

`run_worker` calls a function in a fresh interpreter. The job goes in as JSON, progress and the
result come back as lines of JSON, and large results stay in files. The worker ends when its parent
does, even if the parent is killed, with all programs that it started; a crash of the worker is
reported and harms nothing else. `map_parallel` maps a function over items in a pool of processes,
which end with their parent, too.

Some modules are imported inside functions: ``chronoscene --help`` loads this module.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import IO, TYPE_CHECKING, Any, TypeVar

from chronoscene.errors import ChronoSceneError
from chronoscene.kernels.runtime import available_threads

if TYPE_CHECKING:
    from subprocess import Popen

Item = TypeVar("Item")
Result = TypeVar("Result")

Report = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and its total."""


AGAIN = 0.05  # Seconds after which a request to end that was lost is made once more


@contextmanager
def stoppable() -> Iterator[None]:
    """Turn SIGTERM, which batch systems send, into an exit that cleans up unfinished work.

    If it comes while a finalizer runs, or a callback from C, the exit is lost; it is made again.
    """

    status = 128 + signal.SIGTERM

    def exit_with(number: int, frame: object) -> None:
        raise SystemExit(status)

    def report_lost(lost: sys.UnraisableHookArgs) -> None:
        error = lost.exc_value
        if isinstance(error, SystemExit) and error.code == status:
            # Not here: it would be lost as well.
            threading.Timer(AGAIN, os.kill, (os.getpid(), signal.SIGTERM)).start()
        else:
            hook(lost)

    if threading.current_thread() is not threading.main_thread():
        yield
        return
    hook, sys.unraisablehook = sys.unraisablehook, report_lost
    before = signal.signal(signal.SIGTERM, exit_with)
    try:
        yield
    finally:
        # None stands for a handler that was not set in Python, which cannot be put back.
        signal.signal(signal.SIGTERM, signal.SIG_DFL if before is None else before)
        sys.unraisablehook = hook


GRACE = 5.0  # Seconds that a program has to end after SIGTERM: a container is stopped in them


def process_tree(roots: Iterable[int]) -> set[int]:
    """Find the running ones of some processes, their descendants, and all in their sessions.

    The leader of a session has started its processes, even if the parent in between has ended.
    """
    import psutil

    running = {}
    for process in psutil.process_iter(["ppid", "status"]):
        with suppress(OSError):  # ended in the meantime
            if process.info["status"] != psutil.STATUS_ZOMBIE:
                session = os.getsid(process.pid) if hasattr(os, "getsid") else None
                running[process.pid] = {process.info["ppid"], session}
    members = set(roots)
    while new := {pid for pid, above in running.items() if members & above} - members:
        members |= new
    return members & running.keys()


def end_processes(roots: Iterable[int], *, grace: float = GRACE) -> None:
    """End processes and what they started: SIGTERM, and SIGKILL if they still run after a while."""
    import psutil

    asked: set[int] = set()
    end = time.monotonic() + grace
    while members := process_tree(roots):
        late = time.monotonic() > end
        for pid in members if late else members - asked:
            with suppress(psutil.NoSuchProcess):
                process = psutil.Process(pid)
                process.kill() if late else process.terminate()
        asked |= members
        time.sleep(0.05)


@dataclass(frozen=True, slots=True)
class Outcome:
    """End of a worker."""

    status: int
    """Exit status; the negative number of a signal if one ended the process."""
    message: Mapping[str, Any] | None
    """The last message of the worker, ``{"result": ...}`` or ``{"error": {...}}`` with the
    arguments of a `ChronoSceneError`; None if the process died before it could send one."""

    @property
    def cause(self) -> str:
        """Status in words: ``exit status 1``, ``signal SIGABRT``."""
        if self.status >= 0:
            return f"exit status {self.status}"
        if -self.status == signal.SIGKILL:
            return "signal SIGKILL (out of memory?)"
        known = -self.status in set(signal.Signals)
        return f"signal {signal.Signals(-self.status).name if known else -self.status}"


class Stop:
    """Ends the workers that threads wait for: an interruption reaches the main thread alone."""

    def __init__(self) -> None:
        self.asked = False
        self.workers: set[Popen[str]] = set()

    def ask(self) -> None:
        """End all workers; waiting for one, or starting another, raises a SystemExit."""
        self.asked = True
        for process in tuple(self.workers):
            _end(process)

    def check(self) -> None:
        """Raise the SystemExit if `ask` was called."""
        if self.asked:
            raise SystemExit(1)


def _end(worker: Popen[str]) -> None:
    """Kill a worker, and end what it started."""
    started = process_tree([worker.pid]) - {worker.pid}
    worker.kill()  # not SIGTERM: a library's handler might take its time
    worker.wait()
    end_processes(started)


def run_worker(
    function: str,
    job: Any,
    *,
    report: Report | None = None,
    stop: Stop | None = None,
    log: IO[bytes] | None = None,
    inherited: Sequence[int] = (),
    environment: Mapping[str, str] | None = None,
) -> Outcome:
    """Call a function in a process of its own and wait for its end.

    If waiting is interrupted, the worker is killed, and all that it started is ended.

    Args:
        function: ``module:name``. Takes the job and a `Report`; returns a value for JSON.
        job: A value for JSON.
        report: Called with the progress that the worker reports.
        stop: Ends the worker, if the caller waits in another thread than the main one.
        log: File for everything that the worker and its libraries print; None for our stderr.
        inherited: File descriptors that stay open in the worker.
        environment: Variables that the worker has besides ours.
    """
    from subprocess import PIPE, Popen

    # -P: a file in the current folder must not shadow a module of the standard library.
    command = [sys.executable, "-P", "-m", "chronoscene.io.processes", function, str(os.getpid())]
    process = Popen(
        command,
        stdin=PIPE,
        stdout=PIPE,
        stderr=log,
        text=True,
        pass_fds=inherited,
        env={**os.environ, **(environment or {})},
    )
    stop = stop or Stop()
    stop.workers.add(process)
    try:
        stop.check()
        assert process.stdin is not None
        with suppress(BrokenPipeError):  # it died already
            process.stdin.write(json.dumps(job))
            process.stdin.close()
        message = _listen(process, report)
        outcome = Outcome(process.wait(), message)
        if message is None:
            stop.check()
        return outcome
    except BaseException:
        _end(process)
        raise
    finally:
        stop.workers.discard(process)


def _listen(process: Popen[str], report: Report | None) -> dict[str, Any] | None:
    """Pass progress on until the last message, which is returned."""
    assert process.stdout is not None
    last = None
    for line in process.stdout:
        try:
            message = json.loads(line)
        except ValueError:
            continue  # cut off by the death of the process
        if "progress" not in message:
            last = message
        elif report is not None:
            report(*message["progress"])
    return last


def _end_with(parent: int) -> None:
    """End this process and what it started when its parent is gone, as another may take over."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        end_processes(process_tree([os.getpid()]) - {os.getpid()})
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Run the worker: read the job from stdin, call the function, send progress and its result."""
    import importlib

    _end_with(int(sys.argv[2]))
    channel = os.fdopen(os.dup(1), "w", buffering=1)
    os.dup2(2, 1)  # libraries print to stdout, which is ours alone

    def send(message: Mapping[str, Any]) -> None:
        channel.write(json.dumps(message) + "\n")

    def report(what: str, done: int, total: int) -> None:
        send({"progress": [what, done, total]})

    job = json.load(sys.stdin)
    module, _, name = sys.argv[1].partition(":")
    try:
        send({"result": getattr(importlib.import_module(module), name)(job, report)})
    except ChronoSceneError as error:
        send({"error": error.fields})
    except KeyboardInterrupt:  # the parent has it, too
        sys.exit(130)


def map_parallel(
    function: Callable[[Item], Result],
    items: Sequence[Item],
    *,
    workers: int | None = None,
    lost: Callable[[Item], Result] | None = None,
) -> Iterator[Result]:
    """Yield results in the order of the items, each as soon as all before it are there.

    A process that dies (killed for its memory, or by a fault in a library) ends the whole pool.
    Each item that is left then gets a process of its own, so only the one at fault is lost.

    Args:
        function: At the top level of a module, or a ``partial`` of such a function.
        items: Its arguments.
        workers: Processes; None for one per processor. One item is not worth a process, and one
            worker is none where nothing can be ``lost``.
        lost: The result for an item whose process died; None to raise an error.

    Raises:
        ChronoSceneError: What the function raised on the first item that it failed on.
    """
    from concurrent.futures.process import BrokenProcessPool

    workers = min(workers or available_threads(), len(items))
    if len(items) <= 1 or (workers == 1 and lost is None):
        yield from map(function, items)
        return
    done = 0
    try:
        for result in _pooled(function, items, workers):
            yield result
            done += 1
    except BrokenProcessPool:
        for item in items[done:]:
            try:
                yield from _pooled(function, [item], 1)
            except BrokenProcessPool as error:
                if lost is None:
                    todo = "it may have run out of memory: close programs, or pass fewer at a time"
                    raise ChronoSceneError(
                        item,
                        expected="the process to finish",
                        found="a process that died",
                        todo=todo,
                    ) from error
                yield lost(item)


def _pooled(
    function: Callable[[Item], Result], items: Sequence[Item], workers: int
) -> Iterator[Result]:
    from concurrent.futures import ProcessPoolExecutor
    from multiprocessing import get_context

    spawned, ours = get_context("spawn"), (os.getpid(),)
    with _safe_path():
        pool = ProcessPoolExecutor(workers, spawned, _end_with, ours)  # starts one that keeps watch
    try:
        with _safe_path():
            results = pool.map(partial(_stoppably, function), items)  # starts the others
        yield from results
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


@contextmanager
def _safe_path() -> Iterator[None]:
    """Start processes as with -P: no file in the current folder shadows a module."""
    before = os.environ.get("PYTHONSAFEPATH")
    os.environ["PYTHONSAFEPATH"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["PYTHONSAFEPATH"]
        else:
            os.environ["PYTHONSAFEPATH"] = before


def _stoppably(function: Callable[[Item], Result], item: Item) -> Result:
    try:
        with stoppable():  # temporary files go when the process is asked to end
            return function(item)
    except SystemExit as exit:
        # The pool would take it for the outcome of the item, and wait for a process that goes on.
        os._exit(exit.code if isinstance(exit.code, int) else 1)


if __name__ == "__main__":
    main()
