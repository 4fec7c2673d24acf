"""Runs of a bench in the test process, where nothing is said about processes."""

from __future__ import annotations

from pathlib import Path

import pytest

from chronoscene.harness.files.records import Failure
from chronoscene.harness.plan.job import Job
from chronoscene.harness.run.process import put_in_place, staged
from chronoscene.harness.train.worker import execute


def execute_here(job: Job) -> Failure | None:
    """A job in this process, which costs no time to start."""
    with staged(job) as job:
        execute(job.document(), lambda *progress: None)
    return put_in_place(job, Path(job.staging))


def train_here(patch: pytest.MonkeyPatch) -> None:
    """Let all benches that run one job at a time do so in this process, not warmed up."""
    patch.setattr("chronoscene.harness.run.runner.run_in_process", execute_here)
    patch.setattr("chronoscene.harness.train.worker.warm_up", lambda *args, **options: None)
