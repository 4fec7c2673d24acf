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

from chronoscene.bench.files import records
from chronoscene.bench.plan.job import LOCKS, Job
from chronoscene.bench.plan.plan import (
    BenchSettings,
    Plan,
    Say,
    is_finished,
    is_obsolete,
    plan_jobs,
)
from chronoscene.bench.run.local_pool import Pool, open_pool
from chronoscene.bench.run.process import run_in_process, settle_training
from chronoscene.bench.run.progress import RunsDisplay
from chronoscene.io.processes import stoppable
from chronoscene.methods import MethodSpec

PATIENCE = 1.0  # Seconds from one look for runs that have become free to the next

Lock = AbstractContextManager[object]

Execute = Callable[[Job], records.Failure | None]
"""Runs one job to its end, so that `Job.folder` is complete; returns why it failed, if it did."""


@dataclass(frozen=True, slots=True)
class BenchOutcome:
    """What a bench did."""

    finished: tuple[Path, ...]
    """Folders of the runs of this bench that have a result, old or new."""
    skipped: int
    """How many of them were there before."""
    failures: tuple[records.Failure, ...]


def run_bench(settings: BenchSettings, say: Say, *, execute: Execute | None = None) -> BenchOutcome:
    """Run everything that was asked for and is not finished yet.

    Each finished run is on disk at once, so a bench that was killed resumes where it stopped.

    Args:
        settings: What to run.
        say: Called with lines for the user.
        execute: How to execute one job after the other, instead of what the settings say.

    Raises:
        ChronoSceneError: If anything asked for is wrong; nothing is trained then.
    """
    with open_pool(settings) as pool:
        return run_plan(plan_jobs(settings, say), settings, say, execute=execute, pool=pool)


def run_plan(
    plan: Plan,
    settings: BenchSettings,
    say: Say,
    *,
    execute: Execute | None = None,
    pool: Pool | None = None,
) -> BenchOutcome:
    """Run what is planned and not finished yet, as `run_bench` does.

    Args:
        plan: All runs, each once, in one folder of runs.
        settings: Where that folder is, and whether runs may be replaced.
        say: Called with lines for the user.
        execute: As for `run_bench`; by default `run_in_process`.
        pool: Executes several at a time, if given.
    """
    todo = [(job, spec) for job, spec in plan if not is_finished(job, spec, settings.overwrite)]
    if len(todo) < len(plan):
        say(f"{len(plan) - len(todo)} of {len(plan)} runs are finished and kept")
    for job, spec in todo:
        is_obsolete(job, spec, settings.overwrite)  # raises before anything is trained
    for job, _ in plan:
        if lock := _take(job):
            with lock:
                settle_training(job)  # of a run that was killed between its end and this
    failures = []
    numbers = count(1)

    def run(job: Job, spec: MethodSpec, carry_out: Execute, tell: Say) -> None:
        number = next(numbers)
        if is_finished(job, spec, settings.overwrite):
            tell(f"[{number}/{len(todo)}] {job.label}: another command has finished it")
            return
        if is_obsolete(job, spec, settings.overwrite):
            shutil.rmtree(job.training)
        tell(f"[{number}/{len(todo)}] {job.label}")
        if (failure := carry_out(job)) is not None:
            failures.append(failure)
            tell(f"failed: {job.label}: {failure.reason}")

    try:
        with stoppable():
            if pool is None:
                for job, spec, lock in _in_turn(todo, say):
                    with lock:
                        run(job, spec, execute or run_in_process, say)
            else:
                _run_in_pool(todo, say, pool, run)
    finally:
        records.write_summary(settings.runs)
    finished = [job.folder for job, _ in plan if (job.folder / records.RUN_FILE).is_file()]
    return BenchOutcome(tuple(finished), len(plan) - len(todo), tuple(failures))


def _run_in_pool(
    todo: Plan, say: Say, pool: Pool, run: Callable[[Job, MethodSpec, Execute, Say], None]
) -> None:
    """Run several jobs at a time, each in a thread of its own, which waits for it."""
    under_way: set[Future[None]] = set()
    with RunsDisplay(len(todo), say) as display, ThreadPoolExecutor(pool.at_once) as threads:

        def run_locked(job: Job, spec: MethodSpec, lock: Lock) -> None:
            with lock, display.showing(job.label) as report:
                run(job, spec, partial(pool.run, report=report), display.say)

        try:
            for job, spec, lock in _in_turn(todo, display.say):
                under_way.add(threads.submit(run_locked, job, spec, lock))
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


def _in_turn(todo: Plan, say: Say) -> Iterator[tuple[Job, MethodSpec, Lock]]:
    """Each run with its lock once no other command has it; those that one has now come last."""
    waiting, told = list(todo), False
    while waiting:
        before = len(waiting)
        for run in tuple(waiting):
            if lock := _take(run[0]):
                waiting.remove(run)
                yield *run, lock
        if len(waiting) == before:
            if not told:
                say(f"waiting for another command, which has {waiting[0][0].label}")
            told = True
            time.sleep(PATIENCE)


def _take(job: Job) -> Lock | None:
    """The lock of a run, which a ``with`` block releases; None if another command has it.

    The system frees the lock of a process that is killed.
    """
    file = Path(job.runs) / LOCKS / job.folder.relative_to(job.runs)
    file.parent.mkdir(parents=True, exist_ok=True)
    try:  # the thread that releases it may be another one
        return FileLock(f"{file}.lock", thread_local=False).acquire(blocking=False)
    except Timeout:
        return None
