"""Threads that help with kernels.

A kernel divides its work into jobs that workers draw from a counter. The caller works too and
waits only for helpers that have begun: on a machine with other things to do, a helper that gets
no processor delays nobody, where a barrier of all threads would wait for it. Results do not depend
on who does which job.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numba
import numpy as np

from chronoscene.rasterizer.cpu.phases import look_for_change, new_control

Kernel = Callable[..., Any]

_GENERATION, _ACTIVE = 0, 8  # numbers that are watched without Python's lock
_LOOKS = 20_000
"""How often a helper looks for the next launch before it sleeps: tens of microseconds, which is
what passes between the kernels of one image. Waking a thread takes longer than that."""


@dataclass(slots=True, eq=False)
class _Task:
    """One launch of a kernel. Guarded by the team's mutex."""

    kernel: Kernel
    args: tuple[Any, ...]
    slots: int
    taken: int = 1
    open: bool = True
    caller_sleeps: bool = False
    error: BaseException | None = None


class _Team:
    """Helpers of this process; grows to the largest number asked for."""

    def __init__(self) -> None:
        self.busy = threading.Lock()  # one launch at a time
        self._mutex = threading.Lock()
        self._finished = threading.Lock()
        self._finished.acquire()
        self._shared = np.zeros(16, np.int64)
        self._task: _Task | None = None
        self._wake: list[threading.Lock] = []
        self._awake: list[bool] = []

    def run(self, kernel: Kernel, args: tuple[Any, ...], workers: int) -> None:
        """Call ``kernel(number, *args)`` here with number 0, and in helpers with 1 and so on."""
        task = _Task(kernel, args, workers)
        with self._mutex:
            self._hire(workers - 1)
            self._task = task
            self._shared[_GENERATION] += 1
            for i in range(workers - 1):
                if not self._awake[i]:
                    self._awake[i] = True
                    self._wake[i].release()
        try:
            kernel(0, *args)
        finally:
            self._close(task)
        if task.error is not None:
            raise task.error

    def _close(self, task: _Task) -> None:
        """Let nobody else begin, and wait for those who have: they write to our arrays."""
        with self._mutex:
            task.open, self._task = False, None
            active = int(self._shared[_ACTIVE])
        while active > 0 and look_for_change(self._shared, _ACTIVE, active, _LOOKS):
            active = int(self._shared[_ACTIVE])
        with self._mutex:
            task.caller_sleeps = bool(self._shared[_ACTIVE] > 0)
        interrupted = None
        while task.caller_sleeps:
            try:
                self._finished.acquire()
                task.caller_sleeps = False
            except KeyboardInterrupt as error:
                interrupted = error
        if interrupted is not None:
            raise interrupted

    def _hire(self, helpers: int) -> None:
        while len(self._wake) < helpers:
            self._wake.append(threading.Lock())
            self._wake[-1].acquire()
            self._awake.append(False)
            name = f"rasterizer-{len(self._wake)}"
            args = (len(self._wake) - 1,)
            threading.Thread(target=self._help, args=args, name=name, daemon=True).start()

    def _help(self, me: int) -> None:
        while True:
            self._wake[me].acquire()
            while self._stay(me):
                claim = self._claim()
                if claim is not None:
                    self._work(*claim)

    def _stay(self, me: int) -> bool:
        """Whether there is a task, waiting a little for one; without, this helper is asleep."""
        for last_look in (False, True):
            with self._mutex:
                generation = int(self._shared[_GENERATION])
                if self._task is not None and self._task.taken < self._task.slots:
                    return True
                if last_look:
                    self._awake[me] = False
                    return False
            if look_for_change(self._shared, _GENERATION, generation, _LOOKS):
                return True
        raise AssertionError

    def _claim(self) -> tuple[_Task, int] | None:
        """A place in the present task."""
        with self._mutex:
            task = self._task
            if task is None or task.taken >= task.slots:
                return None
            number = task.taken
            task.taken += 1
            self._shared[_ACTIVE] += 1
            return task, number

    def _work(self, task: _Task, number: int) -> None:
        try:
            task.kernel(number, *task.args)
        except BaseException as error:  # handed to the caller
            task.error = error
        with self._mutex:
            self._shared[_ACTIVE] -= 1
            last = task.caller_sleeps and self._shared[_ACTIVE] == 0
        if last:
            self._finished.release()


_team = _Team()


def _forget() -> None:
    """A forked child has none of its parent's threads."""
    global _team
    _team = _Team()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)


def threads() -> int:
    """Workers to use, the caller included: Numba's setting; see `kernels.threads`."""
    return int(numba.get_num_threads())


def launch(kernel: Kernel, jobs: int, *args: Any, phases: int = 1) -> None:
    """Run a kernel over a number of jobs.

    Args:
        kernel: Called as ``kernel(number, control, *args)``, from several threads.
        jobs: How many there are at most in a phase; no more workers than that are started.
        args: The rest of its arguments.
        phases: How many it has; see `phases`.
    """
    workers, control = min(threads(), jobs), new_control(phases)
    team = _team
    if workers > 1 and team.busy.acquire(blocking=False):
        try:
            team.run(kernel, (control, *args), workers)
        finally:
            team.busy.release()
    else:  # alone, or another thread of the program has the helpers
        kernel(0, control, *args)
