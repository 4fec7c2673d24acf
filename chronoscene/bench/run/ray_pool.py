"""Runs on the machines of a Ray cluster, with shared storage or without.

Each run is an actor with the processors, memory and GPU that it needs. It starts the process of
the run, which ends with it; the actor ends with the bench. Plain data travels between machines, and
files in pieces. Where a machine does not see the folder of runs, it works in a folder of its own.
"""

from __future__ import annotations

import hashlib
import logging
import os
import shutil
import socket
import threading
import uuid
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import chronoscene
from chronoscene.bench.files import records
from chronoscene.bench.files.ground_truth import ground_truth_folder
from chronoscene.bench.files.provenance import code_version
from chronoscene.bench.plan.finished import is_obsolete
from chronoscene.bench.plan.job import LOCKS, Job
from chronoscene.bench.plan.resolve import resolve
from chronoscene.bench.plan.settings import BenchSettings
from chronoscene.bench.run.process import put_in_place, run_in_process, run_staged, staged
from chronoscene.bench.run.transfer import (
    check_arrived,
    content_hash,
    find_copy,
    keep_copy,
    read_pieces,
    write_piece,
)
from chronoscene.errors import BackendError, CheckpointError, ChronoSceneError, ConfigError
from chronoscene.formats.shared.grouping import TABLE
from chronoscene.io.processes import Report, Stop
from chronoscene.io.staging import needing_space, partial_name, remove_abandoned, write_text_atomic
from chronoscene.methods import load_spec

CACHE = "CHRONOSCENE_CACHE"
"""Environment variable of a machine with its folder for scenes and runs that travel."""
PATIENCE = 1.0  # Seconds from one look at a run to the next
GRACE = 5.0  # Seconds for a cluster to answer, and for an interrupted run to end its processes


class RemoteRun:
    """One run on a machine of the cluster."""

    def __init__(self) -> None:
        self._stop = Stop()
        self._notes: list[tuple[str, int, int]] = []
        self._share: tuple[str, int, int] | None = None
        self._folder = Path(os.environ.get(CACHE) or Path.home() / ".cache" / "chronoscene")
        self._copies = self._folder / "copies"
        self._arriving = self._copies / partial_name("arriving")
        self._pieces: Iterator[tuple[str, bytes]] = iter(())

    def describe(self, token: str, secret: str) -> dict[str, Any]:
        """Name and code of the machine, and whether it reads the secret from the bench's file."""
        try:
            shared = Path(token).read_text(encoding="utf-8") == secret
        except OSError:
            shared = False
        code = {"version": chronoscene.__version__, "commit": code_version()}
        return {"host": socket.gethostname(), **code, "shared": shared}

    def find(self, place: str, digest: str) -> str | None:
        """Where this machine has that content; if nowhere, prepares for its pieces."""
        if (found := find_copy(Path(place), digest, self._copies)) is not None:
            return str(found)
        remove_abandoned(self._copies, "arriving")
        return None

    def take(self, name: str, data: bytes) -> None:
        """A piece of what `find` did not find."""
        write_piece(self._arriving, name, data)

    def keep(self, place: str, digest: str) -> str:
        """All of its pieces are here; returns where it is now."""
        return str(keep_copy(self._arriving, digest, self._copies, Path(place).name))

    def run(self, document: dict[str, Any]) -> None:
        """Run a job whose staging folder this machine sees."""
        run_staged(Job.from_document(document), report=self._report, stop=self._stop)

    def run_apart(self, document: dict[str, Any], owner: str) -> str:
        """Run a job in a folder of this machine for that owner; returns the hash of the result."""
        job = Job.from_document(document)
        truth = Path(job.here(str(ground_truth_folder(job.settings.runs, job.scene))))
        job = job.with_settings(runs=self._folder / "runs" / owner)
        link = ground_truth_folder(job.settings.runs, job.scene)
        link.parent.mkdir(parents=True, exist_ok=True)
        partial = link.with_name(partial_name(link.name))
        partial.symlink_to(truth)
        os.replace(partial, link)
        if is_obsolete(resolve(job), overwrite=True):
            shutil.rmtree(job.training)
        run_in_process(job, report=self._report, stop=self._stop)
        self._pieces = read_pieces(job.folder)
        return content_hash(job.folder)

    def piece(self) -> tuple[str, bytes] | None:
        """The next piece of the result; None after the last one."""
        return next(self._pieces, None)

    def forget(self, document: dict[str, Any], owner: str) -> None:
        """Remove the result, which has arrived."""
        job = Job.from_document(document).with_settings(runs=self._folder / "runs" / owner)
        shutil.rmtree(job.folder)

    def progress(self) -> list[tuple[str, int, int]]:
        """What there is to report since the last call."""
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
    try:
        import ray
    except ImportError as error:
        raise ConfigError(
            option,
            expected="the package ray",
            found=str(error),
            todo="pip install 'chronoscene[ray]'",
        ) from error
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
        self._told: set[tuple[str, str]] = set()
        self._digests: dict[Path, str] = {}
        self._lock = threading.Lock()

    def run(self, job: Job, report: Report) -> records.Failure | None:
        """See `Pool.run`."""
        job = job.with_settings(threads=job.settings.threads or self._threads)
        job = replace(job, reports=True)
        with staged(job) as job:
            try:
                self._run(job, report)
            except (self._ray.exceptions.RayError, BackendError, CheckpointError) as error:
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
            raise BackendError(
                self._option,
                expected=f"a machine with {needs['CPU']} processors, {job.memory / 1e9:.2f} GB of "
                f"memory and {needs['GPU']} GPUs",
                found="none",
                todo="use --threads, --job-memory or --device",
            )
        actor = self._ray.remote(RemoteRun).options(
            num_cpus=needs["CPU"], memory=job.memory, num_gpus=needs["GPU"], max_concurrency=2
        )
        remote = actor.remote()
        try:
            machine = self._describe(remote, report)
            travels = "" if machine["shared"] else ", to and from which files travel"
            report(f"{job.label}: on {machine['host']}{travels}", 0, 0)
            moved = self._send(remote, job, machine["shared"])
            document = replace(job, moved=moved).document()

            def tell() -> None:
                for progress in self._get(remote.progress.remote()):
                    report(*progress)

            if machine["shared"]:
                self._get(remote.run.remote(document), tell)
            else:
                self._run_apart(remote, job, document, tell)
            tell()
        except BaseException:
            self._ray.wait([remote.stop.remote()], timeout=GRACE)
            raise
        finally:
            self._ray.kill(remote)

    def _describe(self, remote: Any, report: Report) -> Any:
        """What the machine of an actor says of itself.

        Raises:
            ConfigError: If it has another version; it would fail all runs that it is given.
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
        if commit != self._commit and (host, commit) not in self._told:
            self._told.add((host, commit))
            own = f"this machine that of {self._commit}"
            report(f"note: {host} runs the code of {commit}, {own}; results name theirs", 0, 0)
        return found

    def _send(self, remote: Any, job: Job, shared: bool) -> dict[str, str]:
        """Send what a machine has not; returns `Job.moved`."""
        places = {job.scene_root: Path(job.scene_root)}
        settings = job.settings
        if settings.lpips_weights is not None:
            places[str(settings.lpips_weights)] = settings.lpips_weights
        if settings.period_by is not None and settings.period_by.startswith(TABLE):
            places[settings.period_by] = Path(settings.period_by.removeprefix(TABLE))
        if not shared:
            truth = ground_truth_folder(settings.runs, job.scene)
            places[str(truth)] = truth
            if job.continues:
                places[job.continues] = Path(job.continues)
        moved = {}
        for text, place in places.items():
            with self._lock:  # one thread reads all of it, the others wait
                if place not in self._digests:
                    self._digests[place] = content_hash(place)
            digest = self._digests[place]
            found = self._get(remote.find.remote(str(place), digest))
            if found is None:
                for piece in read_pieces(place):
                    self._get(remote.take.remote(*piece))
                found = self._get(remote.keep.remote(str(place), digest))
            moved[text] = text.replace(str(place), found)
        return moved

    def _run_apart(
        self, remote: Any, job: Job, document: dict[str, Any], tell: Callable[[], None]
    ) -> None:
        """Run a job on a machine that does not see the folder of runs, and fetch the result."""
        owner = hashlib.sha256(f"{socket.gethostname()} {job.settings.runs}".encode()).hexdigest()[
            :16
        ]
        digest = self._get(remote.run_apart.remote(document, owner), tell)
        staging = Path(job.staging)
        with needing_space(job.folder):
            while (piece := self._get(remote.piece.remote())) is not None:
                write_piece(staging, *piece)
        check_arrived(staging, digest)
        self._get(remote.forget.remote(document, owner))
        if (staging / records.RUN_FILE).is_file():  # what an attempt on this machine left
            shutil.rmtree(job.training, ignore_errors=True)

    def _get(self, reference: Any, meanwhile: Callable[[], None] | None = None) -> Any:
        """Wait for what an actor returns."""
        while not self._ray.wait([reference], timeout=PATIENCE)[0]:
            self.stop.check()
            if meanwhile is not None:
                meanwhile()
        return self._ray.get(reference)

    def _on_gpu(self, job: Job) -> bool:
        """Whether a job gets a GPU: where it is asked for, or could be used and there are some."""
        if job.settings.device != "auto":
            return job.settings.device == "cuda"
        return "cuda" in load_spec(job.method).devices and any("GPU" in m for m in self._machines)

    def _reason(self, error: Exception) -> str:
        """Why a run has no result."""
        if isinstance(error, self._ray.exceptions.RayActorError):
            return f"the machine that ran it was lost, or its process there: {error}"
        cause = getattr(error, "cause", error)
        return str(cause) if isinstance(cause, ChronoSceneError) else repr(cause)
