"""Base class of the methods that splat Gaussians.

A subclass of `SplattingMethod` brings a model that gives `Splats` for a view and a period, and a
trainer that changes its tensors.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np
import torch
from torch import Tensor

from chronoscene.errors import ShapeError
from chronoscene.methods import MethodSize, Prediction, StepReport, TrainingSet, View
from chronoscene.rasterizer import Rasterization
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.checkpoint import (
    MISFITS,
    TRAINING,
    TrainingState,
    check_finite,
    load_tensors,
    misfit,
    save_tensors,
)
from chronoscene.training.config import SplattingConfig
from chronoscene.training.drawing import Splats, camera_centre_tensor, prediction_of
from chronoscene.training.exposure import Exposure, exposed, of_period
from chronoscene.training.filtering import adapt_to_plain
from chronoscene.training.periods import with_new_periods
from chronoscene.training.spherical_harmonics import MAX_DEGREE, evaluate
from chronoscene.training.views import count_views

_EXPOSURE = "exposure"  # Name of the stored transforms


class Trainer(Protocol):
    """Interface of what trains a model by single steps."""

    exposure: Exposure

    def step(self, index: int, progress: float) -> StepReport:
        """Do one training step; arguments as of `chronoscene.methods.Method.step`."""

    def state(self) -> TrainingState:
        """Return everything that the steps to come depend on."""

    def load_state(self, state: TrainingState) -> None:
        """Go on from what `state` gave, in a trainer that was made alike."""


class SplattingMethod(ABC):
    """Base class that fulfils `chronoscene.methods.Method` for models of Gaussians.

    A subclass says how a model starts and is drawn.

    `AnchorMethod` and `GaussianMethod` are the two kinds of models that there are.

    Args:
        config: Options of the method, a frozen dataclass on `SplattingConfig`. From `setup` on,
            `config` holds them with lengths in units of the training frame.
    """

    name: ClassVar[str]
    """Name on the command line."""
    version: ClassVar[str] = "1"
    """Version of the implementation; stored with every model."""
    primitive: ClassVar[str]
    """Name of a stored tensor with one row per primitive."""

    def __init__(self, config: SplattingConfig) -> None:
        self.config = config
        self.background = torch.zeros(3)
        self.meta: dict[str, Any] = {}
        """Content of ``model.json``; subclasses add what `restore` needs."""
        self.by_scene = False
        """True if options are in units of the training frame, not as published."""
        self.trainer: Trainer | None = None
        """The trainer that `start` gave; None after `load`."""
        self._exposure: Tensor | None = None

    @abstractmethod
    def start(self, train: TrainingSet, *, seed: int, device: str) -> Trainer:
        """Build the initial model; return its trainer."""

    @abstractmethod
    def draw_splats(self, splats: Splats, view: View, *, plain: bool = False) -> Rasterization:
        """Render Gaussians by the rules of the model, with depth; if plain, without the filter."""

    @abstractmethod
    def splats(self, view: View, period: float, appearance_period: float) -> Splats:
        """Return what is drawn in a view: the geometry of one period, the colours of another."""

    @abstractmethod
    def static_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        """Return what `to_gaussians` does, without the exposure."""

    @abstractmethod
    def stored_tensors(self) -> dict[str, Tensor]:
        """Return the tensors of the model as they go to disk, by name."""

    @abstractmethod
    def restore(self, folder: Path, tensors: dict[str, Tensor], device: str) -> None:
        """Rebuild the model from `stored_tensors` and `meta`."""

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        self.by_scene = self.config.length_unit == "training"
        config = self.config.in_training_frame(train.training_from_world.scale)
        self.config = replace(config, views_per_step=count_views(config.views_per_step))
        background = np.array(train.background, np.float32)
        self.background = torch.from_numpy(background).to(device)
        self.meta = {
            "method": self.name,
            "version": self.version,
            "config": asdict(self.config),
            "training_from_world": train.training_from_world.to_matrix().tolist(),
            "num_periods": train.num_periods,
            "background": background.tolist(),
        }
        self.trainer = self.start(train, seed=seed, device=device)

    def extent(self, train: TrainingSet) -> float:
        """Return the length that rates and bounds are multiples of, in training units.

        Published values are multiples of the extent of the cameras. Where these stand close
        together before what they see, most Gaussians are larger than a tenth of it, and pruned.
        """
        return train.scene_extent if self.by_scene else train.camera_extent

    def go_on(self, train: TrainingSet, trainer: Trainer) -> None:
        """Put another trainer in place of the one before: the last part of `extend`.

        Exposures go on, too; a new period starts with that of the last one.
        """
        exposure = self.exposure()
        self.meta["num_periods"] = train.num_periods
        self.trainer = trainer
        if exposure is not None:
            trainer.exposure.begin(with_new_periods(exposure, train.num_periods))

    def step(self, index: int, progress: float) -> StepReport:
        assert self.trainer is not None, "setup comes first"
        return self.trainer.step(index, progress)

    def render(self, view: View, period: float) -> Prediction:
        return self.render_split(view, geometry_period=period, appearance_period=period)

    @torch.no_grad()
    def render_split(
        self, view: View, *, geometry_period: float, appearance_period: float
    ) -> Prediction:
        """Opacities and shapes come from the first period, colours from the second."""
        transforms = self.exposure()
        exposure = None if transforms is None else of_period(transforms, appearance_period)
        splats = self.splats(view, geometry_period, appearance_period)
        return prediction_of(self.draw_splats(splats, view), exposure)

    @torch.no_grad()
    def to_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        gaussians, transforms = self.static_gaussians(period, views), self.exposure()
        if transforms is None:
            return gaussians
        exposure = of_period(transforms, period).cpu().numpy()
        return replace(gaussians, sh_coeffs=exposed(gaussians.sh_coeffs, exposure))

    @torch.no_grad()
    def render_gaussians(
        self, gaussians: GaussianCloud, view: View, *, plain: bool = False
    ) -> Prediction:
        device = self.background.device
        means, quats, scales, opacities, sh = gaussians.tensors(str(device)).values()
        centre = camera_centre_tensor(view, device)
        colors = evaluate(sh[:, 0], sh[:, 1:], means, centre, MAX_DEGREE)
        splats = Splats(means, quats, scales, opacities, colors)
        return prediction_of(self.draw_splats(splats, view, plain=plain))

    @torch.no_grad()
    def adapt_to_plain(self, gaussians: GaussianCloud, views: Sequence[View]) -> GaussianCloud:
        near_plane = self.config.near_plane
        return adapt_to_plain(gaussians, views, near_plane, self.background.device)

    def exposure(self) -> Tensor | None:
        """Return the transform of colours of each period, if any are learned. [T, 3, 4]"""
        if self.trainer is None:
            return self._exposure
        return self.trainer.exposure.by_period()

    def _all_tensors(self) -> dict[str, Tensor]:
        """Return all tensors that are stored, by name."""
        exposure = self.exposure()
        return self.stored_tensors() | ({} if exposure is None else {_EXPOSURE: exposure})

    def save(self, folder: Path) -> None:
        """Write the model; the state of the optimiser is not stored."""
        save_tensors(folder, self._all_tensors(), self.meta)

    def load(self, folder: Path, *, device: str) -> None:
        """Read a model; what is stored with it takes precedence over the options given here."""
        tensors, self.meta = load_tensors(folder, device=device, method=self.name)
        check_finite(folder, tensors)
        try:
            background = torch.tensor(self.meta["background"], dtype=torch.float32, device=device)
            self.background, self._exposure = background, tensors.pop(_EXPOSURE, None)
            self.restore(folder, tensors, device)
        except MISFITS as error:
            raise misfit(folder, "tensors and a description that fit together", error) from error
        self.trainer = None

    def save_training(self, folder: Path) -> None:
        assert self.trainer is not None, "setup comes first"
        state = self.trainer.state()
        meta = {"method": self.name, "version": self.version, "values": state.values}
        save_tensors(folder, state.tensors, meta, stem=TRAINING)

    def load_training(self, folder: Path) -> None:
        assert self.trainer is not None, "setup comes first"
        tensors, meta = load_tensors(folder, method=self.name, stem=TRAINING)
        try:
            self.trainer.load_state(TrainingState(tensors, meta["values"]))
        except (*MISFITS, ShapeError) as error:
            expected = f"a training that {self.name} {self.version} can go on with"
            todo = "go on with the version of the software, and on the device, that began it"
            raise misfit(folder, expected, error, todo) from error

    def size(self) -> MethodSize:
        """Count the primitives and all stored numbers."""
        tensors = self._all_tensors()
        count, parameters = len(tensors[self.primitive]), sum(t.numel() for t in tensors.values())
        unit = "anchors" if self.primitive == "anchors" else "Gaussians"
        return MethodSize(count, parameters, unit)
