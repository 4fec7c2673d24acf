"""Base class of methods with explicit Gaussians."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.model import SHAPES, GaussianModel, initialise, opacities_of, scales_of
from chronoscene.gaussians.trainer import Due, GaussianTrainer
from chronoscene.methods import TrainingSet, View
from chronoscene.rasterizer import Rasterization
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.checkpoint import META_FILE
from chronoscene.training.device_memory import device_memory
from chronoscene.training.drawing import Splats, draw
from chronoscene.training.method import SplattingMethod


class GaussianMethod(SplattingMethod):
    """Static Gaussians of one scene, to which subclasses add.

    A deformation field, for example, is a `GaussianModel` with `at_period`, made by `make_model`
    with its weights as shared tensors, and their learning rates.
    """

    primitive = "means"
    config_class: ClassVar[type[GaussianConfig]]
    trainer_class: ClassVar[type[GaussianTrainer]] = GaussianTrainer
    shapes: ClassVar[Mapping[str, tuple[int, ...]]] = SHAPES
    """Groups of parameters, with those of `SHAPES`: name to the shape of one row."""
    config: GaussianConfig
    model: GaussianModel
    trainer: GaussianTrainer | None

    def make_model(
        self, parameters: dict[str, Tensor], train: TrainingSet, seed: int
    ) -> GaussianModel:
        """The model before training; ``parameters`` are on the device of the training."""
        return GaussianModel(parameters)

    def extended_model(self, train: TrainingSet) -> GaussianModel:
        """The model at the end of a training, with what it needs for further periods."""
        return self.model

    def restore_model(self, tensors: dict[str, Tensor]) -> GaussianModel:
        """The model from what was stored, with its `meta`."""
        return GaussianModel(tensors, sh_degree=self.meta["sh_degree"])

    def learning_rates(self, due: Due) -> Mapping[str, float]:
        """Learning rate of each tensor at a step."""
        assert self.trainer is not None
        config = self.config
        return {
            "means": due.position_lr * self.trainer.extent,
            "log_scales": config.scale_lr,
            "quats": config.rotation_lr,
            "logit_opacities": config.opacity_lr,
            "sh_dc": config.sh_dc_lr,
            "sh_rest": config.sh_rest_lr,
        }

    def start(self, train: TrainingSet, *, seed: int, device: str) -> GaussianTrainer:
        config = self.config
        parameters = initialise(train, opacity=config.initial_opacity, scale=config.initial_scale)
        self.model = self.make_model({k: v.to(device) for k, v in parameters.items()}, train, seed)
        return self._make_trainer(train, seed)

    def extend(self, train: TrainingSet) -> None:
        """Continue with the present Gaussians: schedules, density control and moments begin anew.

        The sparse points of the new period are not used.
        """
        assert self.trainer is not None, "setup comes first"
        self.model = self.extended_model(train)
        self.go_on(train, self._make_trainer(train, self.trainer.seed))

    def _make_trainer(self, train: TrainingSet, seed: int) -> GaussianTrainer:
        return self.trainer_class(
            self.config,
            self.model,
            train,
            extent=self.extent(train),
            seed=seed,
            background=self.background,
            learning_rates=self.learning_rates,
        )

    def device_memory(self, points: int, periods: int, pixels: int) -> tuple[int, dict[str, int]]:
        numbers = sum(math.prod(shape) for shape in self.shapes.values())
        count = self.config.max_gaussians or points
        return count, device_memory(count, numbers, 1, pixels)

    def splats(self, view: View, period: float, appearance_period: float) -> Splats:
        splats = self.model.splats(view, period)
        if appearance_period == period:
            return splats
        return splats._replace(colors=self.model.splats(view, appearance_period).colors)

    def static_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        if type(self.model).splats is not GaussianModel.splats:
            raise ConfigError(
                self.name,
                expected="static_gaussians beside splats, which draws more than at_period gives",
                found="a method without it",
                todo="write it as docs/guides/adding-a-method.md says, to export runs",
            )
        p = self.model.at_period(period)
        sh_coeffs = torch.cat([p["sh_dc"][:, None], p["sh_rest"]], dim=1)
        scales, opacities = scales_of(p["log_scales"]), opacities_of(p["logit_opacities"])
        tensors = (p["means"], p["quats"], scales, opacities, sh_coeffs)
        return GaussianCloud(*(tensor.cpu().numpy() for tensor in tensors))

    def draw_splats(self, splats: Splats, view: View, *, plain: bool = False) -> Rasterization:
        return draw(
            splats,
            view,
            self.background,
            near_plane=self.config.near_plane,
            antialiased=self.config.antialiased and not plain,
            render_depth=True,
        )

    def stored_tensors(self) -> dict[str, Tensor]:
        return self.model.tensors()

    def permute(self, order: NDArray[np.int64]) -> None:
        rows, parameters = torch.from_numpy(order), self.model.parameters
        self.model.parameters = {name: tensor[rows] for name, tensor in parameters.items()}
        self.model.is_final = False

    def save(self, folder: Path) -> None:
        self.meta["sh_degree"] = self.model.sh_degree
        super().save(folder)

    def restore(self, folder: Path, tensors: dict[str, Tensor], device: str) -> None:
        try:
            # Models from before there was a choice of units do not name theirs.
            self.config = self.config_class(**{"length_unit": "training", **self.meta["config"]})
        except (KeyError, TypeError) as error:
            raise CheckpointError(
                folder / META_FILE,
                expected=f"the configuration of {self.name}",
                found=str(error),
                todo="use the version of the software that wrote it, or train again",
            ) from error
        _check_groups(folder, tensors, self.shapes)
        self.model = self.restore_model(tensors)
        self.model.is_final = True


def _check_groups(
    folder: Path, tensors: Mapping[str, Tensor], shapes: Mapping[str, tuple[int, ...]]
) -> None:
    """Raise unless a checkpoint holds all groups, each with a row for each Gaussian."""
    found = {name: tuple(tensors[name].shape) for name in shapes if name in tensors}
    count = next(iter(found.get("means", ())), None)
    if found != {name: (count, *shape) for name, shape in shapes.items()}:
        stored = ", ".join(f"{name} {list(tensor.shape)}" for name, tensor in tensors.items())
        raise CheckpointError(
            folder / META_FILE,
            expected=f"the parameter groups {', '.join(shapes)}, one row per Gaussian",
            found=stored or "none",
            todo="train again with this version",
        )
