"""4DGS as a plug-in."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from baselines.deformation_4dgs.config import Deformation4DGSConfig
from baselines.deformation_4dgs.field import Field
from baselines.deformation_4dgs.model import DeformedModel, find_box, start_field
from baselines.deformation_4dgs.trainer import DeformationTrainer
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.gaussians.model import SHAPES
from chronoscene.gaussians.trainer import Due
from chronoscene.methods import TrainingSet
from chronoscene.training.points import finite_rows
from chronoscene.training.schedules import log_linear


class Deformation4DGS(GaussianMethod):
    """Canonical Gaussians that a field of six planes moves, turns, scales and repaints over time.

    Source: Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024.
    README.md beside this file says what differs on purpose.
    """

    name = "4dgs"
    config_class = Deformation4DGSConfig
    trainer_class = DeformationTrainer
    config: Deformation4DGSConfig
    model: DeformedModel
    trainer: DeformationTrainer | None

    def start(self, train: TrainingSet, *, seed: int, device: str) -> DeformationTrainer:
        if self.config.white_background:
            self.background = torch.ones_like(self.background)
            self.meta["background"] = self.background.tolist()
        return cast(DeformationTrainer, super().start(train, seed=seed, device=device))

    def make_model(
        self, parameters: dict[str, Tensor], train: TrainingSet, seed: int
    ) -> DeformedModel:
        config, periods = self.config, train.num_periods
        heads = ["means", "log_scales", "quats"]
        heads += ["logit_opacities"] * config.deform_opacity + ["sh"] * config.deform_color
        low, high = find_box(train.points[finite_rows(train.points)], config.box_quantile)
        field = Field(
            low=low,
            high=high,
            sizes=tuple(config.plane_size << level for level in range(config.levels)),
            time_cells=config.time_cells or max(periods, 3),
            channels=config.channels,
            width=config.width,
            heads=tuple(heads),
            offset_unit=config.offset_unit,
        )
        begin = 0.5 if config.half_time_axis else 0.0
        times = np.linspace(begin, 1.0, periods)
        tensors = start_field(field, seed, zero_outputs=config.zero_start)
        device = parameters["means"].device
        shared = {name: tensor.to(device) for name, tensor in tensors.items()}
        return DeformedModel(parameters, shared, field=field, times=tuple(times.tolist()))

    def extended_model(self, train: TrainingSet) -> DeformedModel:
        model = self.model
        while len(model.times) < train.num_periods:
            model = model.with_new_period()
        return model

    def restore_model(self, tensors: dict[str, Tensor]) -> DeformedModel:
        return DeformedModel(
            {name: tensor for name, tensor in tensors.items() if name in SHAPES},
            {name: tensor for name, tensor in tensors.items() if name not in SHAPES},
            sh_degree=self.meta["sh_degree"],
            field=Field(**{k: _tuple(v) for k, v in self.meta["field"].items()}),
            times=tuple(self.meta["times"]),
            is_deforming=self.meta["is_deforming"],
        )

    def save(self, folder: Path) -> None:
        model = self.model
        self.meta["field"], self.meta["times"] = asdict(model.field), model.times
        self.meta["is_deforming"] = model.is_deforming
        super().save(folder)

    def learning_rates(self, due: Due) -> Mapping[str, float]:
        assert self.trainer is not None
        config, field, extent = self.config, self.model.field, self.trainer.extent
        progress = due.moment / config.schedule_length
        planes = log_linear(progress, config.plane_lr_initial, config.plane_lr_final) * extent
        layers = log_linear(progress, config.field_lr_initial, config.field_lr_final) * extent
        rates = {n: planes if n.startswith("planes.") else layers for n in field.shapes()}
        return {**super().learning_rates(due), **rates}


def _tuple(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value
