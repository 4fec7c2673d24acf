"""Several runs at a time: on this machine as its memory allows, or on a Ray cluster."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import Protocol

from chronoscene.harness.files import records
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.harness.run.process import run_in_process
from chronoscene.io.processes import Report, Stop, process_tree
from chronoscene.kernels.runtime import available_threads, machine_memory

PATIENCE = 1.0  # Seconds from one look at the memory that is free to the next


class Pool(Protocol):
    """Place where several jobs are executed at a time."""

    at_once: int
    """Number of jobs at a time."""
    stop: Stop
    """Ends all of them."""

    def run(self, job: Job, report: Report) -> records.Failure | None:
        """Run a job to its end, so that `Job.folder` is complete; called in a thread of its own.

        Args:
            job: The job.
            report: Called with its progress and notes, as `RunsDisplay` takes them.

        Returns:
            The failure, if it failed.
        """
        ...


@contextmanager
def open_pool(settings: BenchSettings) -> Iterator[Pool | None]:
    """Open the pool of the settings; None for one run after the other, here.

    Raises:
        ConfigError: If there is no Ray, or no cluster.
    """
    if settings.ray is None:
        jobs = settings.jobs or 1
        yield LocalPool(jobs) if jobs > 1 else None
        return
    from chronoscene.harness.run.ray_pool import open_ray

    with open_ray(settings) as pool:
        yield pool


class LocalPool:
    """Processes of this machine, which divide its processors.

    A run begins when the memory that it is expected to take is free, or when it is alone.
    """

    def __init__(self, jobs: int) -> None:
        self.at_once = jobs
        self.stop = Stop()
        self._threads = max(1, available_threads() // jobs)
        self._taken: dict[Path, int] = {}
        self._changed = threading.Condition()

    def run(self, job: Job, report: Report) -> records.Failure | None:
        """See `Pool.run`."""
        job = job.with_settings(threads=job.settings.threads or self._threads)
        job = replace(job, reports=True)
        with self._room(job, report):
            return run_in_process(job, report=report, stop=self.stop)

    @contextmanager
    def _room(self, job: Job, report: Report) -> Iterator[None]:
        """Wait for the memory of a job, and keep it for the block."""
        with self._changed:
            reported = False
            while self._taken and self._free() < job.memory:
                if not reported:
                    wanted = f"{job.memory / 1e9:.2f} GB"
                    report(f"{job.label}: waits until {wanted} of memory are free", 0, 0)
                reported = True
                self._changed.wait(PATIENCE)
                self.stop.check()
            self._taken[job.folder] = job.memory
        try:
            yield
        finally:
            with self._changed:
                del self._taken[job.folder]
                self._changed.notify_all()

    def _free(self) -> int:
        """Bytes of free memory, less those that runs under way are still expected to take."""
        import psutil

        held = 0
        for pid in process_tree(process.pid for process in tuple(self.stop.workers)):
            with suppress(psutil.NoSuchProcess):
                held += psutil.Process(pid).memory_info().rss
        return machine_memory()[1] - max(0, sum(self._taken.values()) - held)
