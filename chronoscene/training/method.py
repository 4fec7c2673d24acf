"""What all methods that train tensors here and splat them have in common as plug-ins."""

from __future__ import annotations

from abc import ABC, abstractmethod
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from chronoscene.methods import MethodSize, Prediction, StepReport, TrainingSet, View
from chronoscene.rasterizer import Rasterization
from chronoscene.training.checkpoint import build_meta, load_tensors, save_tensors
from chronoscene.training.rendering import prediction_of


class Trainer(Protocol):
    """What changes the tensors of a model."""

    def step(self, index: int, progress: float) -> StepReport:
        """One training step; arguments as `chronoscene.methods.Method.step`."""


class SplattingMethod(ABC):
    """Fulfils `chronoscene.methods.Method`; a subclass says how a model starts and is drawn.

    `AnchorMethod` and `GaussianMethod` are the two kinds of models that there are.

    Args:
        config: Options of the method, a frozen dataclass.
    """

    name: ClassVar[str]
    """On the command line."""
    version: ClassVar[str] = "1"
    """Of the implementation; stored with every model."""
    primitive: ClassVar[str]
    """Name of a stored tensor with one row per primitive."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.background = torch.zeros(3)
        self.meta: dict[str, Any] = {}
        """Content of ``model.json``; subclasses add what `restore` needs."""
        self.trainer: Any = None
        """A `Trainer`; None after `load`."""

    @abstractmethod
    def start(self, train: TrainingSet, *, seed: int, device: str) -> Trainer:
        """Build the initial model; returns what trains it."""

    @abstractmethod
    def draw(self, view: View, period: float) -> Rasterization:
        """Render a view as of a period, with depth."""

    @abstractmethod
    def stored_tensors(self) -> dict[str, Tensor]:
        """The model as it goes to disk, by name."""

    @abstractmethod
    def restore(self, folder: Path, tensors: dict[str, Tensor], device: str) -> None:
        """Rebuild the model from `stored_tensors` and `meta`."""

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        """Build the initial model and its trainer."""
        background = np.array(train.background, np.float32)
        self.background = torch.from_numpy(background).to(device)
        self.meta = build_meta(
            self.name,
            self.version,
            self.config,
            training_from_world=train.training_from_world,
            num_periods=train.num_periods,
            background=background.tolist(),
        )
        self.trainer = self.start(train, seed=seed, device=device)

    def step(self, index: int, progress: float) -> StepReport:
        """Learn from one training view."""
        assert self.trainer is not None, "setup comes first"
        report: StepReport = self.trainer.step(index, progress)
        return report

    def render(self, view: View, period: float) -> Prediction:
        """Render a view as of a period."""
        with torch.no_grad():
            return prediction_of(self.draw(view, period))

    def save(self, folder: Path) -> None:
        """Write the model; the state of the optimiser is not stored."""
        save_tensors(folder, self.stored_tensors(), self.meta)

    def load(self, folder: Path, *, device: str) -> None:
        """Read a model; what is stored with it takes precedence over the options given here."""
        tensors, self.meta = load_tensors(folder, device=device, method=self.name)
        self.background = torch.tensor(self.meta["background"], dtype=torch.float32, device=device)
        self.restore(folder, tensors, device)
        self.trainer = None

    def size(self) -> MethodSize:
        """Number of primitives, and of all stored numbers."""
        tensors = self.stored_tensors()
        return MethodSize(len(tensors[self.primitive]), sum(t.numel() for t in tensors.values()))
