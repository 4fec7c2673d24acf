"""One scene of Gaussians, and a tint of all their colours in each period."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.gaussians.model import GaussianModel
from chronoscene.gaussians.trainer import Due
from chronoscene.methods import TrainingSet
from chronoscene.training.periods import with_new_periods


@dataclass(frozen=True)
class Config(GaussianConfig):
    """Options beside those of all methods with Gaussians, and other defaults of these."""

    length_unit: Literal["world", "training"] = "training"
    """The unit of the scene does not matter then."""
    stretch: bool = True
    """The schedule is as long as the training."""
    tint_lr: float = 0.01
    """Learning rate of the tints."""


class Model(GaussianModel):
    """Gaussians whose colours are shifted by what is learned for each period."""

    def at_period(self, period: float) -> Mapping[str, Tensor]:
        """The parameters that are drawn; a tint between two periods is mixed from theirs."""
        tints = self.shared["tints"]  # [T, 3]
        before = min(int(period), len(tints) - 1)
        after = min(before + 1, len(tints) - 1)
        tint = torch.lerp(tints[before], tints[after], period - before)
        return self.parameters | {"sh_dc": self.parameters["sh_dc"] + tint}


class TintedGaussians(GaussianMethod):
    """The method; everything that is not here comes from `GaussianMethod`."""

    name = "tinted-gaussians"
    config_class = Config
    config: Config

    def make_model(self, parameters: dict[str, Tensor], train: TrainingSet, seed: int) -> Model:
        """The model before the training: a Gaussian for each sparse point, and no tint."""
        tints = torch.zeros(train.num_periods, 3, device=parameters["means"].device)
        return Model(parameters, {"tints": tints})

    def extended_model(self, train: TrainingSet) -> Model:
        """The model with a tint for each new period, which starts as that of the last one."""
        tints = with_new_periods(self.model.shared["tints"], train.num_periods)
        return Model(self.model.parameters, {"tints": tints}, sh_degree=self.model.sh_degree)

    def restore_model(self, tensors: dict[str, Tensor]) -> Model:
        """The model from its stored tensors."""
        parameters = dict(tensors)
        tints = parameters.pop("tints")
        return Model(parameters, {"tints": tints}, sh_degree=self.meta["sh_degree"])

    def learning_rates(self, due: Due) -> Mapping[str, float]:
        """Learning rate of each tensor in a step."""
        return {**super().learning_rates(due), "tints": self.config.tint_lr}
