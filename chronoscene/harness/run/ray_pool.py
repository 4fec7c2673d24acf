"""Runs on the machines of a Ray cluster, which share the folder of runs and the scenes.

Each run is an actor with the processors, memory and GPU that it needs. It starts the process of
the run, which ends with it; the actor ends with the bench.
"""

from __future__ import annotations

import logging
import shutil
import socket
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import chronoscene
from chronoscene.checks import import_extra
from chronoscene.errors import BackendError, ChronoSceneError, ConfigError
from chronoscene.harness.files import records
from chronoscene.harness.files.provenance import code_version
from chronoscene.harness.files.records import LOCKS
from chronoscene.harness.plan.job import Job
from chronoscene.harness.plan.settings import BenchSettings
from chronoscene.harness.run.process import put_in_place, run_staged, staged
from chronoscene.io.processes import Report, Stop
from chronoscene.io.staging import write_text_atomic
from chronoscene.io.wording import counted, joined
from chronoscene.methods import load_spec

PATIENCE = 1.0  # Seconds from one look at a run to the next
GRACE = 5.0  # Seconds for a cluster to answer, and for an interrupted run to end its processes


class RemoteRun:
    """One run on a machine of the cluster."""

    def __init__(self) -> None:
        self._stop = Stop()
        self._notes: list[tuple[str, int, int]] = []
        self._share: tuple[str, int, int] | None = None

    def describe(self, token: str, secret: str) -> dict[str, Any]:
        """Return name and code of the machine, and whether it reads what the bench has written."""
        try:
            shared = Path(token).read_text(encoding="utf-8") == secret
        except OSError:
            shared = False
        code = {"version": chronoscene.__version__, "commit": code_version()}
        return {"host": socket.gethostname(), **code, "shared": shared}

    def run(self, document: dict[str, Any]) -> None:
        """Run a job, in its staging folder."""
        run_staged(Job.from_document(document), report=self._report, stop=self._stop)

    def progress(self) -> list[tuple[str, int, int]]:
        """Return what there is to report since the last call."""
        notes, self._notes = self._notes, []
        share, self._share = self._share, None
        return [*notes, *([share] if share else [])]

    def stop(self) -> None:
        """End the process of the run."""
        self._stop.ask()

    def _report(self, what: str, done: int, total: int) -> None:
        if total:
            self._share = what, done, total
        else:
            self._notes.append((what, done, total))


@contextmanager
def open_ray(settings: BenchSettings) -> Iterator[RayPool]:
    """A connection to the cluster at ``settings.ray``.

    Raises:
        ConfigError: If there is no Ray, or no cluster.
    """
    option = f"--ray {settings.ray}"
    ray = import_extra("ray", "ray", option)
    try:
        host, _, port = str(settings.ray).removeprefix("ray://").rpartition(":")
        if port.isdigit():  # Ray itself tries for over a minute
            socket.create_connection((host, int(port)), timeout=GRACE).close()
        ray.init(settings.ray, logging_level=logging.ERROR, log_to_driver=False)
    except (OSError, ImportError, RuntimeError, ValueError) as error:
        raise ConfigError(
            option,
            expected="the address of a Ray cluster, or auto on one of its machines",
            found=str(error).partition("\n")[0],
            todo="start one with ray start --head, or correct the address",
        ) from error
    token = settings.run.runs.resolve() / LOCKS / f"{uuid.uuid4()}.token"
    token.parent.mkdir(parents=True, exist_ok=True)
    try:
        write_text_atomic(token, token.stem)
        yield RayPool(ray, settings, token)
    finally:
        token.unlink(missing_ok=True)
        ray.shutdown()


class RayPool:
    """The machines of a cluster; see `Pool`."""

    def __init__(self, ray: Any, settings: BenchSettings, token: Path) -> None:
        self.stop = Stop()
        self._ray, self._token = ray, token
        self._machines = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        processors = [int(machine.get("CPU", 0)) for machine in self._machines]
        self._threads = settings.run.threads or min(filter(None, processors), default=1)
        self.at_once = settings.jobs or max(1, sum(n // self._threads for n in processors))
        self._option = f"--ray {settings.ray}"
        self._commit = code_version()
        self._noted: set[tuple[str, str]] = set()

    def run(self, job: Job, report: Report) -> records.Failure | None:
        """See `Pool.run`."""
        job = job.with_settings(threads=job.settings.threads or self._threads)
        job = replace(job, reports=True)
        with staged(job) as job:
            try:
                self._run(job, report)
            except (self._ray.exceptions.RayError, BackendError) as error:
                shutil.rmtree(job.staging)
                Path(job.staging).mkdir()
                records.write_failure(Path(job.staging), job.failure(self._reason(error)))
        return put_in_place(job, Path(job.staging))

    def _run(self, job: Job, report: Report) -> None:
        """Fill the staging folder of a job by an actor of its own."""
        needs = {
            "CPU": job.settings.threads or 1,
            "memory": job.memory,
            "GPU": int(self._on_gpu(job)),
        }
        if not any(all(m.get(k, 0) >= n for k, n in needs.items()) for m in self._machines):
            wanted = [counted(needs["CPU"], "processor"), f"{job.memory / 1e9:.2f} GB of memory"]
            wanted += ["a GPU"] * needs["GPU"]
            raise BackendError(
                self._option,
                expected=f"a machine with {joined(wanted)}",
                found="none",
                todo="use --threads, --job-memory or --device",
            )
        actor = self._ray.remote(RemoteRun).options(
            num_cpus=needs["CPU"], memory=job.memory, num_gpus=needs["GPU"], max_concurrency=2
        )
        remote = actor.remote()
        try:
            report(f"{job.label}: on {self._check(remote, report)}", 0, 0)

            def pass_on() -> None:
                for progress in self._get(remote.progress.remote()):
                    report(*progress)

            self._get(remote.run.remote(job.document()), pass_on)
            pass_on()
        except BaseException:
            self._ray.wait([remote.stop.remote()], timeout=GRACE)
            raise
        finally:
            self._ray.kill(remote)

    def _check(self, remote: Any, report: Report) -> str:
        """Check the machine of an actor; returns its name.

        Raises:
            ConfigError: If it has another version, or does not see the folder of runs; it would
                fail all runs that it is given.
        """
        expected = f"chronoscene {chronoscene.__version__} on every machine"
        todo = "install the same version on all machines of the cluster"
        try:
            found = self._get(remote.describe.remote(str(self._token), self._token.stem))
        except self._ray.exceptions.RayError as error:
            last = str(error).strip().rpartition("\n")[2]
            raise ConfigError(self._option, expected=expected, found=last, todo=todo) from error
        host, version, commit = found["host"], found["version"], found["commit"]
        if version != chronoscene.__version__:
            raise ConfigError(
                f"{self._option}: {host}", expected=expected, found=version, todo=todo
            )
        if not found["shared"]:
            raise ConfigError(
                f"{self._option}: {host}",
                expected=f"a machine that sees {self._token.parent.parent}",
                found="one that does not",
                todo="put --out and the scenes on storage that all machines have at the same path",
            )
        if commit != self._commit and (host, commit) not in self._noted:
            self._noted.add((host, commit))
            own = f"this machine that of {self._commit}"
            report(f"note: {host} runs the code of {commit}, {own}; results name theirs", 0, 0)
        return str(host)

    def _get(self, reference: Any, meanwhile: Callable[[], None] | None = None) -> Any:
        """Wait for what an actor returns."""
        while not self._ray.wait([reference], timeout=PATIENCE)[0]:
            self.stop.check()
            if meanwhile is not None:
                meanwhile()
        return self._ray.get(reference)

    def _on_gpu(self, job: Job) -> bool:
        """Return True if a job gets a GPU: one that asks for it, or can use it where one is."""
        if job.settings.device != "auto":
            return job.settings.device == "cuda"
        has_gpu = any("GPU" in machine for machine in self._machines)
        return has_gpu and "cuda" in load_spec(job.origin.method).devices

    def _reason(self, error: Exception) -> str:
        """Return the reason why a run has no result."""
        if isinstance(error, self._ray.exceptions.RayActorError):
            return f"the machine that ran it was lost, or its process there: {error}"
        cause = getattr(error, "cause", error)
        return str(cause) if isinstance(cause, ChronoSceneError) else repr(cause)
