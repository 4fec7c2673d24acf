"""The bench: plan all runs, skip the finished ones, execute the others one after another."""

from __future__ import annotations

import os
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from filelock import FileLock, Timeout

from chronoscene.bench import results
from chronoscene.bench.job import Job
from chronoscene.bench.plan import BenchSettings, Plan, Say, is_finished, is_obsolete, plan_jobs
from chronoscene.errors import DiskFullError
from chronoscene.io.processes import run_worker, stoppable
from chronoscene.methods import MethodSpec

LOCKS = ".locks"  # Folder beside the results, with a file for each run
PATIENCE = 1.0  # Seconds from one look for runs that have become free to the next

Execute = Callable[[Job], results.Failure | None]
"""Runs one job to its end, so that `Job.folder` is complete; returns why it failed, if it did."""


@dataclass(frozen=True, slots=True)
class BenchOutcome:
    """What a bench did."""

    finished: tuple[Path, ...]
    """Folders of the runs of this bench that have a result, old or new."""
    skipped: int
    """How many of them were there before."""
    failures: tuple[results.Failure, ...]


def run_bench(settings: BenchSettings, say: Say, *, execute: Execute | None = None) -> BenchOutcome:
    """Run everything that was asked for and is not finished yet.

    Each finished run is on disk at once, so a bench that was killed resumes where it stopped.

    Args:
        settings: What to run.
        say: Called with lines for the user.
        execute: How to execute one job; None for `run_in_process`.

    Raises:
        ChronoSceneError: If anything asked for is wrong; nothing is trained then.
    """
    return run_plan(plan_jobs(settings, say), settings, say, execute=execute)


def run_plan(
    plan: Plan, settings: BenchSettings, say: Say, *, execute: Execute | None = None
) -> BenchOutcome:
    """Run what is planned and not finished yet, as `run_bench` does.

    Args:
        plan: All runs, each once, in one folder of runs.
        settings: Where that folder is, and whether runs may be replaced.
        say: Called with lines for the user.
        execute: As for `run_bench`.
    """
    todo = [(job, spec) for job, spec in plan if not is_finished(job, spec, settings.overwrite)]
    if len(todo) < len(plan):
        say(f"{len(plan) - len(todo)} of {len(plan)} runs are finished and kept")
    for job, spec in todo:
        is_obsolete(job, spec, settings.overwrite)  # raises before anything is trained
    for job, _ in plan:
        with _held(job) as ours:
            if ours:
                settle_training(job)  # of a run that was killed between its end and this
    failures = []
    try:
        with stoppable():
            for number, (job, spec) in enumerate(_in_turn(todo, say), start=1):
                if is_finished(job, spec, settings.overwrite):
                    say(f"[{number}/{len(todo)}] {job.label}: another command has finished it")
                    continue
                if is_obsolete(job, spec, settings.overwrite):
                    shutil.rmtree(job.training)
                say(f"[{number}/{len(todo)}] {job.label}")
                if (failure := (execute or run_in_process)(job)) is not None:
                    failures.append(failure)
                    say(f"failed: {failure.reason}")
    finally:
        results.write_summary(settings.runs)
    finished = [job.folder for job, _ in plan if (job.folder / results.RUN_FILE).is_file()]
    return BenchOutcome(tuple(finished), len(plan) - len(todo), tuple(failures))


def _in_turn(todo: list[tuple[Job, MethodSpec]], say: Say) -> Iterator[tuple[Job, MethodSpec]]:
    """Each run while no other command can have it; those that one has now come last."""
    waiting, told = list(todo), False
    while waiting:
        before = len(waiting)
        for run in tuple(waiting):
            with _held(run[0]) as ours:
                if ours:
                    waiting.remove(run)
                    yield run
        if len(waiting) == before:
            if not told:
                say(f"waiting for another command, which has {waiting[0][0].label}")
            told = True
            time.sleep(PATIENCE)


@contextmanager
def _held(job: Job) -> Iterator[bool]:
    """Whether no other command has the run; none can take it during the block then.

    The system frees the lock of a process that is killed.
    """
    file = Path(job.runs) / LOCKS / job.folder.relative_to(job.runs)
    file.parent.mkdir(parents=True, exist_ok=True)
    lock = FileLock(f"{file}.lock")
    try:
        lock.acquire(blocking=False)
    except Timeout:
        yield False
        return
    try:
        yield True
    finally:
        lock.release()


def run_in_process(job: Job) -> results.Failure | None:
    """Execute a job in a new process on this machine, which shares our terminal.

    The worker writes into a staging folder beside `Job.folder`; it gets its final name once the
    worker has ended, with a result or with ``failed.json``.
    """
    staging = _fresh_staging(job.folder)
    try:
        outcome = run_worker(
            "chronoscene.bench.worker:execute", asdict(replace(job, staging=str(staging)))
        )
        if outcome.message is not None and "error" in outcome.message:
            raise DiskFullError(**outcome.message["error"])
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise
    finished = outcome.status == 0 and (staging / results.RUN_FILE).is_file()
    if not finished and not (staging / results.FAILURE_FILE).is_file():
        (staging / results.RUN_FILE).unlink(missing_ok=True)
        results.write_failure(staging, job.failure(f"the process ended with {outcome.cause}"))
    return put_in_place(job, staging)


def put_in_place(job: Job, staging: Path) -> results.Failure | None:
    """Give what a worker wrote its final name; returns why the run failed, if it did."""
    failure = results.read_failure(staging)
    if job.folder.exists():
        shutil.rmtree(job.folder)
    os.replace(staging, job.folder)
    settle_training(job)
    return failure


def settle_training(job: Job) -> None:
    """Remove the checkpoints of a finished run, or keep them with it."""
    finished = (job.folder / results.RUN_FILE).is_file()
    if not finished or not (job.training / results.CONFIG_FILE).is_file():
        return
    if results.read_config(job.training) != results.read_config(job.folder):
        return  # of a longer training that is under way
    os.sync()  # the result, before that from which it could be made again goes
    if job.keep_training:
        shutil.rmtree(job.folder / results.TRAINING, ignore_errors=True)
        os.replace(job.training, job.folder / results.TRAINING)
    else:
        shutil.rmtree(job.training)


def _fresh_staging(folder: Path) -> Path:
    """An empty folder beside the final one, after removing what a killed bench left there.

    The name holds our process id: a worker of a killed bench may still write into its own.
    """
    for stale in folder.parent.glob(f".{folder.name}.*.partial"):
        shutil.rmtree(stale, ignore_errors=True)
    staging = folder.with_name(f".{folder.name}.{os.getpid()}.partial")
    staging.mkdir(parents=True)
    return staging
