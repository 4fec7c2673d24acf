"""A pool of threads that run kernels together, and how they share the work.

A kernel divides its work into jobs that workers draw from a counter. The caller is a worker too,
and at the end waits only for those others that have begun: on a machine with other things to do, a
thread that gets no processor delays nobody, where a barrier of all threads would wait for it.
Results do not depend on who does which job.

A kernel may have several phases. Each has a counter that jobs are drawn from and a counter of
finished jobs. Between phases a worker waits for jobs, not for workers: who comes late finds
everything done and passes through.
"""

from __future__ import annotations

import atexit
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from chronoscene.kernels.compilation import inlined, inner, kernel
from chronoscene.kernels.memory import fetch_add, load_shared

_STRIDE = 16  # Numbers per phase, so that phases do not share cache lines
_FINISHED = 8
_PATIENCE = 64  # Looks before the processor is offered to others

_CAN_YIELD = hasattr(os, "sched_yield")
_sched_yield = numba.types.ExternalFunction("sched_yield", numba.types.int32())


# What kernels call.


@inlined
def draw(control: Any, phase: int) -> int:
    """Draw the number of a job for this worker; too large a number when all are taken."""
    return fetch_add(control, _STRIDE * phase, 1)


@inlined
def finish(control: Any, phase: int) -> None:
    """Mark a drawn job as done."""
    fetch_add(control, _STRIDE * phase + _FINISHED, 1)


@inner
def wait_for(control, phase, jobs):
    """Wait until all jobs of a phase are done."""
    looks = 0
    while load_shared(control, _STRIDE * phase + _FINISHED) < jobs:
        looks += 1
        if _CAN_YIELD and looks % _PATIENCE == 0:
            _sched_yield()


@kernel
def _wait_for_change(shared, offset, value, looks):
    """Wait a while for a number to change; True if it did."""
    for look in range(looks):
        if load_shared(shared, offset) != value:
            return True
        if _CAN_YIELD and look % _PATIENCE == _PATIENCE - 1:
            _sched_yield()
    return False


# What runs them.

Kernel = Callable[..., Any]

_GENERATION, _ACTIVE = 0, 8  # Numbers that are watched without Python's lock
_LOOKS = 20_000
"""Number of checks for the next launch before a worker sleeps: tens of microseconds, the pause
between the kernels of one image. Waking a thread takes longer than that."""


@dataclass(slots=True, eq=False)
class _Task:
    """One launch of a kernel. Guarded by the pool's mutex."""

    kernel: Kernel
    args: tuple[Any, ...]
    workers: int
    taken: int = 1
    error: BaseException | None = None


class _Pool:
    """Threads of this process that wait for kernels; grows to the largest number asked for."""

    def __init__(self) -> None:
        self.busy = threading.Lock()  # one launch at a time
        self._mutex = threading.Lock()
        self._idle = threading.Condition(self._mutex)
        self._shared = np.zeros(16, np.int64)
        self._task: _Task | None = None
        self._stopped = False
        self._threads: list[threading.Thread] = []
        self._wake: list[threading.Lock] = []
        self._awake: list[bool] = []

    def run(self, kernel: Kernel, args: tuple[Any, ...], workers: int) -> None:
        """Call ``kernel(number, *args)`` here with number 0, and in threads with 1 and so on."""
        task = _Task(kernel, args, workers)
        with self._mutex:
            self._start_threads(workers - 1)
            self._task = task
            self._wake_threads(workers - 1)
        try:
            kernel(0, *args)
        finally:
            self._close()
        if task.error is not None:
            raise task.error

    def stop(self) -> None:
        """End the threads, after what they are doing; later launches have one worker."""
        with self._mutex:
            self._stopped = True
            self._wake_threads(len(self._threads))
        for thread in self._threads:
            thread.join()

    def _close(self) -> None:
        """Let no other worker begin, and wait for those that have: they write to our arrays."""
        with self._mutex:
            self._task = None
        interrupted = None
        while True:
            try:
                self._wait_until_idle()
                break
            except KeyboardInterrupt as error:
                interrupted = error
        if interrupted is not None:
            raise interrupted

    def _wait_until_idle(self) -> None:
        while (active := int(self._shared[_ACTIVE])) > 0:
            if not _wait_for_change(self._shared, _ACTIVE, active, _LOOKS):
                break
        with self._idle:
            while self._shared[_ACTIVE] > 0:
                self._idle.wait()

    def _start_threads(self, count: int) -> None:
        while len(self._threads) < count and not self._stopped:
            self._wake.append(threading.Lock())
            self._wake[-1].acquire()
            self._awake.append(False)
            name = f"kernels-{len(self._wake)}"
            args = (len(self._wake) - 1,)
            thread = threading.Thread(target=self._serve, args=args, name=name, daemon=True)
            self._threads.append(thread)
            thread.start()

    def _wake_threads(self, count: int) -> None:
        """Let the first threads look for what is new. The caller holds the mutex."""
        self._shared[_GENERATION] += 1
        for i in range(min(count, len(self._threads))):
            if not self._awake[i]:
                self._awake[i] = True
                self._wake[i].release()

    def _serve(self, me: int) -> None:
        """Main loop of a worker thread."""
        while not self._stopped:
            self._wake[me].acquire()
            while self._stay(me):
                self._work()

    def _stay(self, me: int) -> bool:
        """Wait a little for a task; False, with this thread marked as asleep, if there is none."""
        for last_look in (False, True):
            with self._mutex:
                generation = int(self._shared[_GENERATION])
                if self._task is not None and self._task.taken < self._task.workers:
                    return True
                if last_look or self._stopped:
                    self._awake[me] = False
                    return False
            if _wait_for_change(self._shared, _GENERATION, generation, _LOOKS):
                return True
        raise AssertionError

    def _work(self) -> None:
        """Take part in the present task, if it has a place."""
        with self._mutex:
            task = self._task
            if task is None or task.taken >= task.workers:
                return
            number = task.taken
            task.taken += 1
            self._shared[_ACTIVE] += 1
        try:
            task.kernel(number, *task.args)
        except BaseException as error:  # handed to the caller
            task.error = error
        # The caller has it still, and frees its arrays: not this thread, at any later time.
        del task
        with self._idle:
            self._shared[_ACTIVE] -= 1
            if self._shared[_ACTIVE] == 0:
                self._idle.notify()


_pool = _Pool()
_spare: list[_Pool] = []
_own = threading.local()


def _forget() -> None:
    """Make a new pool in a forked child, which has none of its parent's threads."""
    global _pool, _spare
    _pool, _spare = _Pool(), []


def spare_pools(count: int) -> list[_Pool]:
    """Return pools beside that of the program, always the same ones."""
    while len(_spare) < count:
        _spare.append(_Pool())
    return _spare[:count]


def use_pool(pool: _Pool) -> None:
    """Let the launches of this thread use a pool that no other thread uses meanwhile."""
    _own.pool = pool


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


@atexit.register
def _stop_all() -> None:
    """End all threads before the interpreter goes.

    The interpreter would unwind the stacks of threads that wait for its lock, and the process
    aborts if there is a frame of C++ that allows no exceptions.
    """
    for pool in (_pool, *_spare):
        pool.stop()


def num_workers() -> int:
    """Workers to use, the caller included: Numba's setting, see `runtime.set_threads`."""
    return int(numba.get_num_threads())


def new_control(phases: int = 1) -> NDArray[np.int64]:
    """Counters of a launch."""
    return np.zeros(phases * _STRIDE, np.int64)


def launch(kernel: Kernel, jobs: int, *args: Any, phases: int = 1) -> None:
    """Run a kernel over a number of jobs.

    Args:
        kernel: Called as ``kernel(number, control, *args)``, from several threads.
        jobs: How many there are at most in a phase; no more workers than that are used.
        args: The rest of its arguments.
        phases: How many it has.
    """
    workers, control = min(num_workers(), jobs), new_control(phases)
    pool: _Pool = getattr(_own, "pool", _pool)
    if workers > 1 and pool.busy.acquire(blocking=False):
        try:
            pool.run(kernel, (control, *args), workers)
        finally:
            pool.busy.release()
    else:  # alone, or another thread of the program uses the pool
        kernel(0, control, *args)
