"""The process of a run, and what counts as its result."""

from dataclasses import replace
from types import SimpleNamespace

import pytest

from chronoscene.harness.files.records import RUN_FILE, read_failure
from chronoscene.harness.run import process

from ..plan.test_job import JOB


@pytest.mark.parametrize("status", [1, -9])
def test_a_process_that_failed_has_no_result_whatever_it_wrote(tmp_path, monkeypatch, status):
    (tmp_path / RUN_FILE).touch()
    outcome = SimpleNamespace(status=status, message=None, cause=f"status {status}")
    monkeypatch.setattr(process, "run_worker", lambda *args, **options: outcome)
    process.run_staged(replace(JOB, staging=str(tmp_path)))
    assert not (tmp_path / RUN_FILE).exists()
    assert read_failure(tmp_path).reason == f"the process ended with status {status}"


def test_what_an_interrupted_deletion_has_left_goes_once_the_run_is_finished(tmp_path):
    """The settings may have gone first."""
    job = JOB.with_settings(runs=tmp_path)
    job.folder.mkdir(parents=True)
    left = job.training / "all" / "500"
    left.mkdir(parents=True)
    process.settle_training(job)
    assert left.is_dir()
    (job.folder / RUN_FILE).touch()
    process.settle_training(job)
    assert not job.training.exists()
