"""Threads that run kernels together."""

from __future__ import annotations

import os
import signal
import threading
import time
import weakref
from typing import Any

import numba
import numpy as np
import pytest
from fresh_process import run_python

from chronoscene.kernels.thread_pool import launch

MAX_THREADS: int = numba.config.NUMBA_NUM_THREADS  # type: ignore[attr-defined]


def test_every_job_is_done_once_and_waited_for(threads: Any) -> None:
    """Many short launches, with more workers than processors."""
    threads(MAX_THREADS)
    done = np.zeros(50, np.int64)

    def kernel(worker: int, control: np.ndarray, jobs: np.ndarray) -> None:
        while True:
            with lock:
                job = int(control[0])
                control[0] += 1
            if job >= jobs.size:
                return
            jobs[job] += 1

    lock = threading.Lock()
    for k in range(300):
        launch(kernel, 50, done)
        assert (done == k + 1).all()


@pytest.mark.skipif(MAX_THREADS < 2, reason="needs two threads")
def test_an_error_in_a_worker_reaches_the_caller(threads: Any) -> None:
    threads(2)
    entered = threading.Event()

    def kernel(worker: int, control: np.ndarray) -> None:
        if worker == 1:
            entered.set()
            raise ZeroDivisionError
        assert entered.wait(30)

    with pytest.raises(ZeroDivisionError):
        launch(kernel, 2)
    launch(lambda worker, control: None, 2)  # and the pool works on


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_child_can_launch() -> None:
    """The child has none of the threads that the parent's pool counts on."""
    code = """
import os, numpy as np
from chronoscene.kernels.thread_pool import launch
def kernel(worker, control, seen): seen[worker] += 1
launch(kernel, 2, np.zeros(2))
child = os.fork()
if child == 0:
    seen = np.zeros(2)
    launch(kernel, 2, seen)
    os._exit(0 if seen[0] == 1 else 1)
assert os.waitpid(child, 0)[1] == 0
"""
    run_python(code)


def test_threads_end_before_the_interpreter_goes() -> None:
    """A thread that waits for its lock then is unwound, which aborts where C++ frames forbid it."""
    code = """
import atexit, threading
def check():
    assert [thread.name for thread in threading.enumerate()] == ["MainThread"]
    launch(kernel, 4, np.zeros(4))  # and whoever ends later can still launch
    print("checked")
atexit.register(check)  # callbacks run in the reverse order
import numba, numpy as np
from chronoscene.kernels.thread_pool import launch
def kernel(worker, control, seen): seen[worker] += 1
numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
launch(kernel, 4, np.zeros(4))
launch(kernel, 4, np.zeros(4))
"""
    assert "checked" in run_python(code)


@pytest.mark.skipif(MAX_THREADS < 2, reason="needs two threads")
def test_idle_threads_keep_no_arrays(threads: Any) -> None:
    threads(2)
    entered = threading.Event()

    def kernel(worker: int, control: np.ndarray, array: np.ndarray) -> None:
        if worker == 1:
            entered.set()
        assert entered.wait(30)

    array = np.zeros(4)
    alive = weakref.ref(array)
    launch(kernel, 2, array)
    del array
    assert alive() is None


@pytest.mark.skipif(MAX_THREADS < 2, reason="needs two threads")
@pytest.mark.skipif(os.name != "posix", reason="needs POSIX signals")
def test_interruptions_wait_for_workers(threads: Any) -> None:
    """Ctrl-C, twice, while a worker still writes: raised once it has ended."""
    threads(2)
    entered, ended = threading.Event(), threading.Event()

    def kernel(worker: int, control: np.ndarray) -> None:
        if worker == 1:
            entered.set()
            for _ in range(2):
                time.sleep(0.2)
                signal.raise_signal(signal.SIGINT)
            time.sleep(0.2)
            ended.set()
        else:
            assert entered.wait(30)

    with pytest.raises(KeyboardInterrupt):
        launch(kernel, 2)
    assert ended.is_set()
