"""The method that is checked, and functions that checks share."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors import safe_open

from chronoscene.harness.contract import tiny_training
from chronoscene.harness.train import painted_balls
from chronoscene.harness.train.checks import refuse
from chronoscene.methods import (
    Method,
    MethodSpec,
    StepReport,
    TrainingSet,
    View,
    load_spec,
    make_method,
)

PAUSE = 63
"""Steps after which a training is interrupted; densification has begun by then."""


class NotApplicableError(Exception):
    """A check that does not apply to a method, with the reason."""


@dataclass
class Subject:
    """A method that is checked: trained once, and kept with its saved model."""

    name: str
    """Name, or ``module:SPEC``."""
    scratch: Path
    """Folder for files of the checks."""

    @cached_property
    def spec(self) -> MethodSpec:
        return load_spec(self.name)

    @cached_property
    def data(self) -> TrainingSet:
        return painted_balls.make_training_set(tiny_training.periods_for(self.spec))

    @cached_property
    def _trained(self) -> tuple[Method, list[StepReport]]:
        return tiny_training.train(self.spec, self.data)

    @property
    def method(self) -> Method:
        """The trained method; not to be trained further."""
        return self._trained[0]

    @property
    def reports(self) -> list[StepReport]:
        """Reports of its training steps."""
        return self._trained[1]

    @cached_property
    def model(self) -> Path:
        """Folder of the saved model."""
        return self.save(self.method)

    @cached_property
    def interrupted(self) -> Path:
        """Folder of a training that was saved after `PAUSE` steps."""
        if not self.spec.resumable:
            raise NotApplicableError("the method cannot be resumed")
        method = self.begun()
        go_on(method, 0, PAUSE)
        folder = self.folder()
        method.save_training(folder)
        return folder

    @cached_property
    def elsewhere(self) -> Path:
        """Folder of `train_elsewhere`."""
        return train_elsewhere([self.name], self.folder())

    def folder(self) -> Path:
        """Make an empty folder."""
        return Path(mkdtemp(dir=self.scratch))

    def fresh(self) -> Method:
        """Return a method without a model."""
        return make_method(self.spec, tiny_training.small_config(self.spec))

    def begun(self, data: TrainingSet | None = None) -> Method:
        """Return a method before its first step, with other data than `data` if given."""
        method = self.fresh()
        method.setup(data or self.data, seed=0, device="cpu")
        return method

    def loaded(self) -> Method:
        """Return a new method with the saved model."""
        method = self.fresh()
        method.load(self.model, device="cpu")
        return method

    def resumed(self, folder: Path) -> Method:
        """Return a new method with the training in a folder."""
        method = self.begun()
        method.load_training(folder)
        return method

    def save(self, method: Method) -> Path:
        """Save a model into a new folder."""
        folder = self.folder()
        method.save(folder)
        return folder


def go_on(method: Method, start: int, stop: int = tiny_training.STEPS) -> list[StepReport]:
    """Do some steps of the training on painted balls."""
    return [method.step(i, i / tiny_training.STEPS) for i in range(start, stop)]


def contents(folder: Path) -> dict[str, bytes]:
    """Read all files below a folder."""
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def resized(view: View, width: int, height: int) -> View:
    """Return the view at another size."""
    scale = np.diag([width / view.width, height / view.height, 1.0])
    return View(scale @ view.K, width, height, view.cam_from_world)


def demand(met: Any, place: str, expected: str, found: object = "something else") -> None:
    """Raise a `MethodError` unless a condition is met."""
    if not met:
        raise refuse(place, expected, found)


def same_files(one: Path, other: Path, place: str, expected: str) -> None:
    """Demand that two folders have the same files, byte for byte."""
    a, b = contents(one), contents(other)
    differ = sorted(name for name in a.keys() | b.keys() if a.get(name) != b.get(name))
    demand(not differ, place, expected, f"a difference in {', '.join(differ)}")


def tensors_of(folder: Path) -> dict[str, NDArray[Any]]:
    """Read the tensors of a saved model, by name."""
    with safe_open(folder / "model.safetensors", framework="numpy") as tensors:
        return {key: tensors.get_tensor(key) for key in tensors.keys()}  # noqa: SIM118


def train_elsewhere(names: Sequence[str], folder: Path) -> Path:
    """Train methods in one other process, with another hash seed and with renderings in between.

    Returns:
        The folder: models in ``out``, by name; in ``cwd`` and ``tmp`` what else was written.
    """
    for name in ("out", "cwd", "tmp"):
        (folder / name).mkdir()
    done = python(
        "-m", "chronoscene.harness.contract.tiny_training", str(folder / "out"), *names,
        cwd=folder / "cwd", PYTHONHASHSEED="77", TMPDIR=str(folder / "tmp"),
    )  # fmt: skip
    demand(done.returncode == 0, "training in another process", "success", done.stderr.strip())
    return folder


def python(
    *arguments: str, cwd: Path | None = None, **environment: str
) -> subprocess.CompletedProcess[str]:
    """Run another interpreter that finds the same modules."""
    return subprocess.run(
        [sys.executable, *arguments],
        cwd=cwd,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path)), **environment},
        capture_output=True,
        text=True,
    )
