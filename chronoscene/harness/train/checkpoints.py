"""Checkpoints of a training, from which a run that was killed continues.

A checkpoint of a model is the folder ``<root>/<model>/<iterations>/``: the files of the method, and
``loop.json`` with the state of the loop and the digests of these files, which reveal damage. It is
written under another name, flushed to the disk and renamed; the one before is kept. The settings of
the run are in ``<root>/config.json``. Nothing is pickled.
"""

from __future__ import annotations

import os
import random
import shutil
import time
from dataclasses import dataclass
from json import dumps
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, NonNegativeInt, ValidationError

from chronoscene.errors import CheckpointError, DiskFullError
from chronoscene.harness.files.provenance import peak_memory_bytes
from chronoscene.harness.files.records import CONFIG_FILE, CurvePoint
from chronoscene.io.documents import plain_file
from chronoscene.io.log import Log
from chronoscene.io.staging import partial_name, remove_abandoned, sha256_of, write_text_atomic
from chronoscene.methods import Method

LOOP_FILE = "loop.json"
_Seconds = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class LoopState(BaseModel):
    """State of the training of a model, apart from the state of the method."""

    model_config = ConfigDict(extra="forbid", ser_json_inf_nan="strings")

    format_version: Literal[1] = 1
    iterations: NonNegativeInt = 0
    """Steps done; one of several views counts as so many, here and below."""
    seconds: _Seconds = 0.0
    """Time on the training clock."""
    setup_seconds: _Seconds = 0.0
    waited_seconds: _Seconds = 0.0
    """Time spent waiting for photos, or stopped; not on the training clock."""
    empty_steps: int = 0
    """Steps whose view showed no primitive."""
    skipped_steps: int = 0
    """Steps whose loss or gradients were not finite."""
    first_loss: float | None = None
    """Loss of the first step with a finite one."""
    curve: list[CurvePoint] = []
    resumed: int = 0
    """Number of times that the training continued from a checkpoint."""
    commits: list[str] = []
    """Commits of the code that trained up to a checkpoint, without repetitions."""
    devices: list[str] = []
    """Devices likewise, with their threads."""
    peak_memory_bytes: int = 0
    """Peak of the processes so far; 0 if the system does not report it."""
    random_state: dict[str, Any] = {}
    """State of the global generators."""
    files: dict[str, str] = {}
    """SHA-256 of the files of the method by their names."""


@dataclass
class Checkpoints:
    """The checkpoints of one model of a run."""

    folder: Path
    """Folder of this model alone; created when it is needed."""
    settings: dict[str, Any]
    """Settings of the run, written beside the folder."""
    commit: str
    """Commit of the code that trains now."""
    device: str
    """Device on which it trains, with its threads."""
    every: float
    """Seconds between checkpoints."""
    keep_last: bool
    """True if a checkpoint is written at the end of the training and kept as the only one."""
    start: Path | None
    """Folder with checkpoints of a shorter training of the same model, to begin with."""
    log: Log

    def __post_init__(self) -> None:
        self._latest = time.monotonic()

    def restore(self, method: Method) -> LoopState | None:
        """Load the newest intact checkpoint; return None if there are no checkpoints.

        Args:
            method: A method that is set up.

        Raises:
            CheckpointError: If there are some, but all are damaged, or if `start` has none.
        """
        remove_abandoned(self.folder, "*")
        started = [] if self.start is None else _checkpoints(self.start)
        problems = []
        for folder in (*_checkpoints(self.folder), *started):
            try:
                state = _read(folder)
                method.load_training(folder)
                _set_random_state(folder, state.random_state)
            except CheckpointError as error:
                problems.append(error)
                continue
            state.resumed += 1
            for problem in problems:
                self.log(f"note: a checkpoint is not used: {problem}")
            self.log(f"going on from iteration {state.iterations}")
            return state
        if problems or self.start is not None:
            raise CheckpointError(
                self.folder,
                expected="a checkpoint to go on from",
                found=str(problems[0]) if problems else "none",
                todo=f"delete {self.folder.parent} to train from the beginning",
            )
        return None

    @property
    def is_due(self) -> bool:
        """True if enough time has passed since the last attempt to write one."""
        return time.monotonic() - self._latest >= self.every

    def finish(self, method: Method, state: LoopState) -> None:
        """Write the last checkpoint, if it is kept."""
        if self.keep_last:
            self.write(method, state, keep=1)

    def write(self, method: Method, state: LoopState, *, keep: int = 2) -> None:
        """Write a checkpoint; the training goes on without it if the disk refuses."""
        state.random_state = _random_state()
        state.peak_memory_bytes = max(state.peak_memory_bytes, peak_memory_bytes() or 0)
        for known, now in ((state.commits, self.commit), (state.devices, self.device)):
            if now not in known:
                known.append(now)
        partial = self.folder / partial_name(str(state.iterations))
        settings = self.folder.parent / CONFIG_FILE
        try:
            partial.mkdir(parents=True, exist_ok=True)
            if not settings.exists():
                write_text_atomic(settings, dumps(self.settings))
            method.save_training(partial)
            state.files = {path.name: sha256_of(path) for path in partial.iterdir()}
            (partial / LOOP_FILE).write_text(state.model_dump_json(), encoding="utf-8")
            for path in (*partial.iterdir(), partial, settings, settings.parent):
                _flush(path)
            final = self.folder / str(state.iterations)
            shutil.rmtree(final, ignore_errors=True)  # damaged, else this training began with it
            os.replace(partial, final)
            _flush(self.folder)
        except (OSError, DiskFullError) as error:
            shutil.rmtree(partial, ignore_errors=True)
            self.log(f"note: no checkpoint of iteration {state.iterations}: {error}")
        else:
            for old in _checkpoints(self.folder)[keep:]:
                shutil.rmtree(old, ignore_errors=True)
        self._latest = time.monotonic()


def _checkpoints(folder: Path) -> list[Path]:
    """Return the checkpoints of a model, the newest first."""
    found = [path for path in folder.glob("*") if path.name.isdigit()]
    return sorted(found, key=lambda path: -int(path.name))


def _read(folder: Path) -> LoopState:
    """Read the state of the loop and check the files of a checkpoint."""
    path = folder / LOOP_FILE
    try:
        state = LoopState.model_validate_json(plain_file(path).read_bytes())
        for name, digest in state.files.items():
            path = folder / Path(name).name
            if sha256_of(path) != digest:
                raise _damaged(path, "another content")
    except OSError as error:
        raise _damaged(path, error.strerror or str(error)) from error
    except ValidationError as error:
        first = error.errors()[0]
        raise _damaged(path, f"{first['msg']} ({'.'.join(map(str, first['loc']))})") from error
    except ValueError as error:  # a name that no file can have
        raise _damaged(path, str(error)) from error
    return state


def _damaged(path: Path, found: str) -> CheckpointError:
    todo = "the checkpoint is damaged or of another version"
    return CheckpointError(path, expected="what the training wrote", found=found, todo=todo)


def _flush(path: Path) -> None:
    """Wait until a file, or the list of a folder's files, is on the disk."""
    number = os.open(path, os.O_RDONLY)
    try:
        os.fsync(number)
    finally:
        os.close(number)


def _random_state() -> dict[str, Any]:
    import torch

    name, keys, *others = np.random.get_state()
    states = {"torch": torch.get_rng_state()}
    if torch.cuda.is_initialized():
        states["cuda"] = torch.cuda.get_rng_state()
    hexadecimal = {name: state.numpy().tobytes().hex() for name, state in states.items()}
    return {
        "python": random.getstate(),
        "numpy": [name, np.asarray(keys).tolist(), *others],
        **hexadecimal,
    }


def _set_random_state(folder: Path, state: dict[str, Any]) -> None:
    """Set the global generators to the state in a checkpoint."""
    import torch

    try:
        version, numbers, gauss = state["python"]
        random.setstate((version, tuple(numbers), gauss))
        np.random.set_state(tuple(state["numpy"]))
        torch.set_rng_state(torch.frombuffer(bytearray.fromhex(state["torch"]), dtype=torch.uint8))
        if "cuda" in state and torch.cuda.is_available():
            cuda = torch.frombuffer(bytearray.fromhex(state["cuda"]), dtype=torch.uint8)
            torch.cuda.set_rng_state(cuda)
    except (KeyError, OverflowError, RuntimeError, TypeError, ValueError) as error:
        found = f"{type(error).__name__}: {error} (random_state)"
        raise _damaged(folder / LOOP_FILE, found) from error
