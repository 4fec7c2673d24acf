"""Training of Gaussians in space and time."""

from __future__ import annotations

from baselines.realtime_4dgs.config import Realtime4DGSConfig
from baselines.realtime_4dgs.model import SpacetimeModel, scatter_in_spacetime
from baselines.realtime_4dgs.slicing import ORDERS
from chronoscene.gaussians.trainer import GaussianTrainer
from chronoscene.methods import StepReport


class SpacetimeTrainer(GaussianTrainer):
    """Waves of the colours come in after the spherical harmonics, one order after the other."""

    config: Realtime4DGSConfig
    model: SpacetimeModel
    scatter = staticmethod(scatter_in_spacetime)

    def step(self, index: int, progress: float) -> StepReport:
        config, moment = self.config, self.timeline.moment(progress)
        begin = config.sh_degree * config.sh_interval
        self.model.order = min(max(moment - begin, 0) // config.wave_interval, ORDERS)
        return super().step(index, progress)
