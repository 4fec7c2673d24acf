"""CLNeRF as a plug-in."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from baselines.continual_nerf.config import ContinualConfig
from baselines.continual_nerf.replay import ReplayMethod
from chronoscene.fields.method import Drawn
from chronoscene.fields.network import Codes
from chronoscene.fields.rays import Rays
from chronoscene.methods import TrainingSet
from chronoscene.training.periods import with_new_periods

_CHARBONNIER = 1e-6  # Added to the square


class CLNeRF(ReplayMethod):
    """A hash grid with codes of each period for geometry and appearance; learned period by period.

    Source: Cai and Müller 2023, "CLNeRF: Continual Learning Meets NeRF". README.md beside this file
    says what differs on purpose.
    """

    name = "clnerf"
    config: ContinualConfig

    def initial(self, train: TrainingSet, generator: torch.Generator) -> dict[str, Tensor]:
        config, periods = self.config, train.num_periods
        sizes = config.geometry_size, config.appearance_size
        params = self.network_class.initial(config, *sizes, generator)
        for name, size in zip(("geometry", "appearance"), sizes, strict=True):
            params[name] = 0.1 * torch.randn(periods, size, generator=generator)
        return params

    def codes(self, rays: Rays) -> Codes:
        periods = self.pool.periods[rays.views]
        names = "geometry", "appearance"
        return Codes(*(self.network.params[name].index_select(0, periods) for name in names))

    def view_codes(self, geometry_period: float, appearance_period: float) -> Codes:
        params = self.network.params
        return Codes(
            self.mixed(params["geometry"], geometry_period),
            self.mixed(params["appearance"], appearance_period),
        )

    def loss(self, drawn: Drawn, rays: Rays, progress: float) -> Tensor:
        """Return the loss; with that of MEIL-NeRF, replayed rays have an error of their own."""
        loss = super().loss(drawn, rays, progress)
        if self.config.replay_loss == "squared" or self.replayed == 0:
            return loss
        squares = (drawn.rgb - rays.colors).square()
        old = (rays.views < self.replayed).float()[:, None]
        weight = (1 + math.cos(math.pi * (1 + progress))) / 2
        robust = weight * torch.sqrt(squares + _CHARBONNIER)
        return loss + (old * (robust - squares)).mean()

    def extended(self, train: TrainingSet) -> dict[str, Tensor]:
        params = dict(self.network.params)
        for name in ("geometry", "appearance"):
            params[name] = with_new_periods(params[name], train.num_periods)
        return params


class MEILNeRF(CLNeRF):
    """The same with the replay loss of MEIL-NeRF, as the repository of CLNeRF has it.

    Source: Chung et al. 2022, "MEIL-NeRF: Memory-Efficient Incremental Learning of Neural Radiance
    Fields"; its learned generator of rays is not part of that code, nor of this.
    """

    name = "meil-nerf"
