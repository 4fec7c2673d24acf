"""Threads that run kernels together."""

from __future__ import annotations

import os
import threading
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
