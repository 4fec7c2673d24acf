"""One job on this machine: a staging folder, a process, and the result put in place."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from chronoscene.errors import DiskFullError
from chronoscene.harness.files import records
from chronoscene.harness.plan.job import Job
from chronoscene.io.processes import Report, Stop, run_worker
from chronoscene.io.staging import partial_name, remove_abandoned


def run_in_process(
    job: Job, *, report: Report | None = None, stop: Stop | None = None
) -> records.Failure | None:
    """Execute a job in a new process on this machine, which shares our terminal.

    The worker writes into a staging folder beside `Job.folder`; it gets its final name once the
    worker has ended, with a result or with ``failed.json``.

    Args:
        job: What to run.
        report: As for `run_worker`; of jobs that report their progress.
        stop: As for `run_worker`.
    """
    with staged(job) as job:
        run_staged(job, report=report, stop=stop)
    return put_in_place(job, Path(job.staging))


@contextmanager
def staged(job: Job) -> Iterator[Job]:
    """Yield the job with an empty staging folder beside its final one, deleted if the block fails.

    Its name says who made it: workers of a killed bench may still write into theirs.
    """
    remove_abandoned(job.folder.parent, job.folder.name)
    staging = job.folder.with_name(partial_name(job.folder.name))
    staging.mkdir(parents=True)
    try:
        yield replace(job, staging=str(staging))
    except BaseException:
        shutil.rmtree(staging, ignore_errors=True)
        raise


def run_staged(job: Job, *, report: Report | None = None, stop: Stop | None = None) -> None:
    """Execute a job in a new process, which leaves a result or a failure in its staging folder.

    Raises:
        DiskFullError: If there is no space for either.
    """
    staging = Path(job.staging)
    outcome = run_worker(
        "chronoscene.harness.train.worker:execute", job.document(), report=report, stop=stop
    )
    if outcome.message is not None and "error" in outcome.message:
        raise DiskFullError(**outcome.message["error"])
    finished = outcome.status == 0 and (staging / records.RUN_FILE).is_file()
    if not finished and not (staging / records.FAILURE_FILE).is_file():
        (staging / records.RUN_FILE).unlink(missing_ok=True)
        records.write_failure(staging, job.failure(f"the process ended with {outcome.cause}"))


def put_in_place(job: Job, staging: Path) -> records.Failure | None:
    """Move what a worker wrote to its final place; return the failure of the run, if it failed."""
    failure = records.read_failure(staging)
    if job.folder.exists():
        shutil.rmtree(job.folder)
    os.replace(staging, job.folder)
    settle_training(job)
    return failure


def settle_training(job: Job) -> None:
    """Remove the checkpoints of a finished run, or keep them with it."""
    if not (job.folder / records.RUN_FILE).is_file() or not job.training.is_dir():
        return
    if not (job.training / records.CONFIG_FILE).is_file():
        shutil.rmtree(job.training)  # what an interrupted deletion has left
        return
    if records.read_config(job.training) != records.read_config(job.folder):
        return  # of a longer training that is under way
    os.sync()  # the result, before that from which it could be made again goes
    if job.settings.keep_training:
        shutil.rmtree(job.folder / records.TRAINING, ignore_errors=True)
        os.replace(job.training, job.folder / records.TRAINING)
    else:
        shutil.rmtree(job.training)
