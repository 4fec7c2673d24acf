"""The work folder: stages are done once, so that a killed command continues where it was.

A stage stores a record when it has succeeded: a fingerprint of all its inputs, its result, and its
remarks. The record is written last, to a temporary name that is renamed. A stage whose record has
another fingerprint is done again, and so is everything after it, because the fingerprint of a stage
covers the one before.

pycolmap can abort the process, and deadlocks after a fork. Its tasks therefore run in a fresh
interpreter (see `chronoscene.io.processes`): an abort turns into a message, and what the
task had stored stays.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from chronoscene.errors import DiskFullError, RegistrationError, SceneError
from chronoscene.io.documents import read_json_document
from chronoscene.io.processes import Report, run_worker
from chronoscene.io.staging import write_text_atomic

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None  # type: ignore[assignment]

LOCK = "lock"
VERSION = 2  # Version of what stages store; other versions are not read
PATIENCE = 5.0  # Seconds; a task ends within one second after its command was killed


def fingerprint(*parts: Any) -> str:
    """SHA-256 of values, which JSON can hold."""
    text = json.dumps(parts, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()


@dataclass
class Stages:
    """The stages of one run, in order."""

    folder: Path
    """The work folder."""
    previous: str = ""
    """Fingerprint of the last stage."""
    log: list[dict[str, Any]] = field(default_factory=list)
    """A record of each stage: name, seconds, remarks, whether it was done in an earlier run."""

    def run(self, name: str, inputs: Any, action: Callable[[], tuple[Any, Sequence[str]]]) -> Any:
        """Run a stage unless it was done with the same inputs before; return its result.

        Args:
            name: Of the stage, and of its record.
            inputs: All that the result depends on besides the stages before, as JSON holds it.
            action: Gives the result, as JSON holds it, and remarks for the log.
        """
        key = fingerprint(VERSION, name, self.previous, inputs)
        path = self.folder / f"stage-{name}.json"
        record = read_record(path)
        if record is None or record.get("key") != key:
            path.unlink(missing_ok=True)
            started = time.monotonic()
            result, remarks = action()
            record = {
                "key": key,
                "stage": name,
                "seconds": round(time.monotonic() - started, 2),
                "remarks": list(remarks),
                "result": result,
            }
            write_text_atomic(path, json.dumps(record, indent=1) + "\n")
            resumed = False
        else:
            resumed = True
        entry = {k: record[k] for k in ("stage", "seconds", "remarks")}
        self.log.append(entry | {"from_an_earlier_run": resumed})
        self.previous = key
        return record["result"]

    def remark(self, stage: str, *remarks: str) -> None:
        """Log a decision that was not made in a stage."""
        entry = {"stage": stage, "seconds": 0.0, "remarks": list(remarks)}
        self.log.append(entry | {"from_an_earlier_run": False})


def read_record(path: Path) -> dict[str, Any] | None:
    """Read a dictionary from a JSON file; None if there is none that can be read."""
    try:
        record: dict[str, Any] = read_json_document(path)
    except SceneError:
        return None
    return record


@contextmanager
def work_folder(path: Path, patience: float = PATIENCE) -> Iterator[int]:
    """Create a work folder and keep others out of it while the block runs.

    What ends the block early gets a note that the folder was kept, and what for.

    Args:
        path: The folder.
        patience: Seconds to wait for another process to leave it.

    Yields:
        A file descriptor. A process that inherits it keeps others out as well: tasks do, so that
        those of a killed command end before the next command begins.

    Raises:
        RegistrationError: If something else is in it, another process works in it, or the system
            has no locks of this kind.
    """
    if fcntl is None:
        raise RegistrationError(
            "register",
            expected="Linux or macOS, whose file locks keep two runs apart",
            found=sys.platform,
            todo="run it in the Windows Subsystem for Linux (WSL)",
        )
    path.mkdir(parents=True, exist_ok=True)
    if any(path.iterdir()) and not (path / LOCK).is_file():  # photos/ in it would be emptied
        raise RegistrationError(
            path,
            expected="a new or empty work folder, or that of an earlier run",
            found="other files",
            todo="choose another folder",
        )
    with (path / LOCK).open("w") as lock:
        end = time.monotonic() + patience
        while not _locked(lock.fileno()):
            if time.monotonic() > end:
                raise RegistrationError(
                    path,
                    expected="a work folder that is not in use",
                    found="another registration in it",
                    todo="wait for it to end, or choose another folder (--work)",
                )
            time.sleep(0.1)
        try:
            yield lock.fileno()
        except BaseException as error:
            error.add_note(
                f"{path} was kept: run the same command again to continue from there, or delete "
                "the folder to start from scratch"
            )
            raise


def _locked(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


TASKS = {
    "features": "chronoscene.registration.features.extraction:extract",
    "matches": "chronoscene.registration.features.matching:match_photos",
    "joint": "chronoscene.registration.reconstruct.routes:joint",
    "separate": "chronoscene.registration.reconstruct.routes:separate",
    "frozen": "chronoscene.registration.reconstruct.routes:add_period",
    "triangulate": "chronoscene.registration.reconstruct.known_poses:triangulate_scene",
    "resection": "chronoscene.registration.control.resection:resect",
    "refine": "chronoscene.registration.reconstruct.routes:refine",
}
"""``module:function`` of each task. It takes a dictionary and a `Report`, and returns JSON data."""

ENVIRONMENT = {"OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"}
"""Tasks start their own threads; those of a matrix library would wait spinning beside them."""

LEAST_SPACE = 64_000_000
"""Bytes; if a task dies and there is less, a full disk was the cause. Some of what it wrote is
already deleted by then."""

LOG_LINES = 4  # Lines of the task's own output in a message


def run_task(
    task: str,
    arguments: Mapping[str, Any],
    *,
    log: Path,
    report: Report | None = None,
    inherited: Sequence[int] = (),
) -> Any:
    """Run a task in a process of its own and return its result.

    Args:
        task: One of `TASKS`.
        arguments: What JSON can hold.
        log: File to which the task's own output is appended.
        report: Called with its progress.
        inherited: File descriptors that stay open in the process.

    Raises:
        DiskFullError: If the process dies and there is hardly any space left.
        RegistrationError: If it dies otherwise.
        ChronoSceneError: What the task raised, as a `RegistrationError` with the same words.
    """
    with log.open("ab") as file:
        outcome = run_worker(
            TASKS[task],
            arguments,
            report=report,
            log=file,
            inherited=inherited,
            environment=ENVIRONMENT,
        )
    if outcome.message is None:
        _check_space(log.parent)
        said = _end_of(log)
        raise RegistrationError(
            f"task {task}",
            expected="the task to finish",
            found=f"{outcome.cause} ({said})" if said else outcome.cause,
            todo="run the command again; if it happens again, try --threads 1 or other settings; "
            f"see {log}",
        )
    if "error" in outcome.message:
        raise RegistrationError(**outcome.message["error"])
    return outcome.message["result"]


def _check_space(folder: Path) -> None:
    """Raise an error if the disk is full: libraries abort there, and the log gives no reason."""
    free = shutil.disk_usage(folder).free
    if free < LEAST_SPACE:
        raise DiskFullError(
            folder,
            expected="space for what is written there",
            found=f"{free / 1e6:.1f} MB left",
            todo="make room on this disk, or choose a place on another one (--work)",
        )


def _end_of(log: Path) -> str:
    """The last lines of a log on one line."""
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return " / ".join(line.strip()[:160] for line in lines[-LOG_LINES:])
