"""Training of 4DGS in two stages: static Gaussians, then Gaussians with their field."""

from __future__ import annotations

from dataclasses import replace

from torch import Tensor

from baselines.deformation_4dgs.config import Deformation4DGSConfig
from baselines.deformation_4dgs.field.smoothness import Weights, smoothness
from baselines.deformation_4dgs.model import DeformedModel
from chronoscene.gaussians.trainer import Due, GaussianTrainer, Timeline
from chronoscene.methods import StepReport
from chronoscene.rasterizer import Rasterization
from chronoscene.training.checkpoint import TrainingState


class TwoStages(Timeline):
    """Counts moments anew in the second stage; the degree of the colours goes on."""

    config: Deformation4DGSConfig

    def is_fine(self, index: int, progress: float) -> bool:
        """Return True if the second stage has begun."""
        return super().moment(index, progress) > self.config.coarse_until

    def moment(self, index: int, progress: float) -> int:
        before = self.config.coarse_until if self.is_fine(index, progress) else 0
        return super().moment(index, progress) - before

    def at(self, index: int, progress: float, views: int = 1) -> Due:
        config = self.config
        degree = super().moment(index, progress) // config.sh_interval
        return replace(super().at(index, progress, views), sh_degree=min(config.sh_degree, degree))


class DeformationTrainer(GaussianTrainer):
    """Trainer of both stages: the second begins with a new optimiser and new statistics.

    `DeformedModel.is_deforming` records that it has begun.
    """

    config: Deformation4DGSConfig
    model: DeformedModel
    timeline: TwoStages
    timeline_class = TwoStages

    def step(self, index: int, progress: float) -> StepReport:
        if not self.model.is_deforming and self.timeline.is_fine(index, progress):
            self.model.is_deforming = True
            self.begin()
        return super().step(index, progress)

    def state(self) -> TrainingState:
        state = super().state()
        state.values["is_deforming"] = self.model.is_deforming
        return state

    def load_state(self, state: TrainingState) -> None:
        super().load_state(state)
        self.model.is_deforming = state.values["is_deforming"]

    def loss(self, raster: Rasterization, number: int, mask: Tensor | None) -> Tensor:
        photometric = super().loss(raster, number, mask)
        if not self.model.is_deforming:
            return photometric
        config = self.config
        weights = Weights(
            space=config.space_smoothness, time=config.time_smoothness, ones=config.time_sparsity
        )
        return photometric + smoothness(self.model.shared, self.model.field, weights)
