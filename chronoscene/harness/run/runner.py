"""The bench: plan all runs, skip the finished ones, execute the others."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import AbstractContextManager
from dataclasses import dataclass
from functools import partial
from itertools import count
from pathlib import Path

from filelock import FileLock, Timeout

from chronoscene.harness.files import records
from chronoscene.harness.plan.finished import is_finished, is_obsolete
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.plan import Plan, plan_runs
from chronoscene.harness.plan.resolve import ResolvedRun
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.harness.run.local_pool import Pool, open_pool
from chronoscene.harness.run.process import run_in_process, settle_training
from chronoscene.harness.run.progress import RunsDisplay
from chronoscene.io.log import Log
from chronoscene.io.processes import stoppable

PATIENCE = 1.0  # Seconds from one look for runs that have become free to the next

Lock = AbstractContextManager[object]

Execute = Callable[[Job], records.Failure | None]
"""Runs one job to its end, so that `Job.folder` is complete; returns why it failed, if it did."""


@dataclass(frozen=True, slots=True)
class BenchOutcome:
    """Outcome of a bench."""

    finished: tuple[Path, ...]
    """Folders of the runs of this bench that have a result, old or new."""
    skipped: int
    """Number of runs that were finished before."""
    failures: tuple[records.Failure, ...]


def run_bench(settings: BenchSettings, log: Log, *, execute: Execute | None = None) -> BenchOutcome:
    """Run everything that was asked for and is not finished yet.

    Each finished run is on disk at once, so a bench that was killed resumes where it stopped.

    Args:
        settings: What to run.
        log: Called with lines for the user.
        execute: How to execute one job after the other, instead of what the settings say.

    Raises:
        ChronoSceneError: If anything asked for is wrong; nothing is trained then.
    """
    with open_pool(settings) as pool:
        return run_plan(plan_runs(settings, log), settings, log, execute=execute, pool=pool)


def run_plan(
    plan: Plan,
    settings: BenchSettings,
    log: Log,
    *,
    execute: Execute | None = None,
    pool: Pool | None = None,
) -> BenchOutcome:
    """Run what is planned and not finished yet, as `run_bench` does.

    Args:
        plan: All runs, in one folder of runs.
        settings: Where that folder is, and whether runs may be replaced.
        log: Called with lines for the user.
        execute: As for `run_bench`; by default `run_in_process`.
        pool: Executes several at a time, if given.
    """
    todo = list(plan.todo.values())
    if len(todo) < len(plan.runs):
        log(f"{len(plan.runs) - len(todo)} of {len(plan.runs)} runs are finished and kept")
    for run in plan.runs.values():
        if lock := _take(run.job):
            with lock:
                settle_training(run.job)  # of a run that was killed between its end and this
    failures = []
    numbers = count(1)

    def carry_out(run: ResolvedRun, execute: Execute, log: Log) -> bool:
        job, number = run.job, f"[{next(numbers)}/{len(todo)}]"
        if is_finished(run, settings.overwrite):
            log(f"{number} {job.label}: another command has finished it")
            return False
        if is_obsolete(run, settings.overwrite):
            shutil.rmtree(job.training)
        log(f"{number} {job.label}")
        if (failure := execute(job)) is not None:
            failures.append(failure)
            log(f"failed: {job.label}: {failure.reason}")
            if (trace := job.folder / records.ERROR_LOG).is_file():
                log(f"{job.label}: {trace}")
        return failure is None

    try:
        with stoppable():
            if pool is None:
                for run, lock in _in_turn(todo, log):
                    with lock:
                        carry_out(run, execute or run_in_process, log)
            else:
                _run_in_pool(todo, log, pool, carry_out)
    finally:
        for reason in records.write_summary_of_readable(settings.run.runs).values():
            log(f"left out of {records.RESULTS_FILE}: {reason}")
    finished = tuple(folder for folder in plan.runs if (folder / records.RUN_FILE).is_file())
    return BenchOutcome(finished, len(plan.runs) - len(todo), tuple(failures))


def _run_in_pool(
    todo: list[ResolvedRun],
    log: Log,
    pool: Pool,
    carry_out: Callable[[ResolvedRun, Execute, Log], bool],
) -> None:
    """Carry out several runs at a time, each in a thread of its own, which waits for it.

    ``carry_out`` returns True if it has made a result.
    """
    under_way: set[Future[None]] = set()
    with RunsDisplay(len(todo), log) as display, ThreadPoolExecutor(pool.at_once) as threads:

        def locked(run: ResolvedRun, lock: Lock) -> None:
            with lock, display.showing() as report:
                if not carry_out(run, partial(pool.run, report=report), display.log):
                    display.leave_out(report)

        try:
            for run, lock in _in_turn(todo, display.log):
                under_way.add(threads.submit(locked, run, lock))
                while len(under_way) == pool.at_once:
                    under_way = _without_ended(under_way)
            while under_way:
                under_way = _without_ended(under_way)
        except BaseException:
            pool.stop.ask()
            raise


def _without_ended(under_way: set[Future[None]]) -> set[Future[None]]:
    """Wait until one has ended; raise its error if there is one."""
    ended, others = wait(under_way, return_when=FIRST_COMPLETED)
    for future in ended:
        future.result()
    return others


def _in_turn(todo: list[ResolvedRun], log: Log) -> Iterator[tuple[ResolvedRun, Lock]]:
    """Yield each run with its lock once it is free; runs of another command come last."""
    waiting, announced = list(todo), False
    while waiting:
        before = len(waiting)
        for run in tuple(waiting):
            if lock := _take(run.job):
                waiting.remove(run)
                yield run, lock
        if len(waiting) == before:
            if not announced:
                log(f"waiting for another command, which has {waiting[0].job.label}")
            announced = True
            time.sleep(PATIENCE)


def _take(job: Job) -> Lock | None:
    """Take the lock of a run, for a ``with`` block; None if another command has it.

    The system frees the lock of a process that is killed.
    """
    runs = job.settings.runs
    file = runs / records.LOCKS / job.folder.relative_to(runs)
    file.parent.mkdir(parents=True, exist_ok=True)
    try:  # the thread that releases it may be another one
        return FileLock(f"{file}.lock", thread_local=False).acquire(blocking=False)
    except Timeout:
        return None
