"""CL-Splats as a plug-in."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.cl_splats.config import CLSplatsConfig
from baselines.cl_splats.lifting import begin_period
from baselines.cl_splats.model import LIVES, PeriodModel, no_gaussians
from baselines.cl_splats.trainer import CLSplatsTrainer
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.gaussians.model import SHAPES, initialise
from chronoscene.gaussians.trainer import GaussianTrainer
from chronoscene.methods import TrainingSet, View
from chronoscene.training.drawing import Splats


class CLSplats(GaussianMethod):
    """Gaussians of which only those are optimised that a new period shows to have changed.

    Source: Ackermann et al. 2025, "CL-Splats: Continual Learning of Gaussian Splatting with Local
    Optimization". README.md beside this file says what differs on purpose.
    """

    name = "cl-splats"
    config_class = CLSplatsConfig
    trainer_class = CLSplatsTrainer
    shapes: ClassVar = {**SHAPES, LIVES: (2,)}
    config: CLSplatsConfig
    model: PeriodModel

    trainer: CLSplatsTrainer | None

    def start(self, train: TrainingSet, *, seed: int, device: str) -> GaussianTrainer:
        """Under ``joint``, too, the model begins with what the first period shows."""
        config, first = self.config, min(view.period for view in train.views)
        seen = train.point_periods[:, first]
        points = replace(train, points=train.points[seen], colors=train.colors[seen])
        parameters = initialise(points, opacity=config.initial_opacity, scale=config.initial_scale)
        self.model = PeriodModel(
            {name: tensor.to(device) for name, tensor in parameters.items()},
            kept=no_gaussians(device),
            period=first,
        )
        return self._make_trainer(train, seed)

    def _make_trainer(self, train: TrainingSet, seed: int) -> GaussianTrainer:
        trainer = super()._make_trainer(train, seed)
        assert isinstance(trainer, CLSplatsTrainer)
        trainer.begin_period = self.extended_model
        return trainer

    def extended_model(self, train: TrainingSet) -> PeriodModel:
        """The model with what has changed in a new period in training."""
        assert self.trainer is not None
        begin_period(
            self.model,
            train,
            self.render,
            self.config,
            extent=self.extent(train),
            seed=self.trainer.seed,
        )
        return self.model

    def splats(self, view: View, period: float, appearance_period: float) -> Splats:
        """Each Gaussian has one colour: of another period there is the exposure alone to take."""
        del appearance_period
        return self.model.splats(view, period)

    def restore_model(self, tensors: dict[str, Tensor]) -> PeriodModel:
        """The model with nothing in training."""
        nothing = {name: tensors[name][:0] for name in SHAPES}
        return PeriodModel(nothing, sh_degree=self.meta["sh_degree"], kept=tensors)

    def stored_tensors(self) -> dict[str, Tensor]:
        return self.model.everything()

    def permute(self, order: NDArray[np.int64]) -> None:
        rows = torch.from_numpy(order)
        self.model.keep({name: tensor[rows] for name, tensor in self.model.kept.items()})
