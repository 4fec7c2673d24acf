"""Training of Gaussians in space and time."""

from __future__ import annotations

from baselines.realtime_4dgs.config import Realtime4DGSConfig
from baselines.realtime_4dgs.model import SpacetimeModel, scatter_in_spacetime
from baselines.realtime_4dgs.slicing import ORDERS
from chronoscene.gaussians.trainer import GaussianTrainer
from chronoscene.methods import StepReport
from chronoscene.training.checkpoint import TrainingState


class SpacetimeTrainer(GaussianTrainer):
    """Waves of the colours come in after the spherical harmonics, one order after the other."""

    config: Realtime4DGSConfig
    model: SpacetimeModel
    scatter = staticmethod(scatter_in_spacetime)

    def step(self, index: int, progress: float) -> StepReport:
        config, moment = self.config, self.timeline.moment(index, progress)
        begin = config.sh_degree * config.sh_interval
        due = min(max(moment - begin, 0) // config.wave_interval, ORDERS)
        # Higher than what is due at the start of a training that goes on with a model.
        self.model.order = max(due, self.model.order)
        return super().step(index, progress)

    def state(self) -> TrainingState:
        state = super().state()
        state.values["order"] = self.model.order
        return state

    def load_state(self, state: TrainingState) -> None:
        super().load_state(state)
        self.model.order = state.values["order"]
