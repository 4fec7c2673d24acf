"""GS-W as a plug-in."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.gaussian_in_the_wild.config import GaussianInTheWildConfig
from baselines.gaussian_in_the_wild.features import start_coordinates
from baselines.gaussian_in_the_wild.model import COORDINATES, EARLIER, WildModel
from baselines.gaussian_in_the_wild.networks import Networks, start_networks
from baselines.gaussian_in_the_wild.trainer import WildTrainer, one_thread
from chronoscene.anchors.baking import RIDGE
from chronoscene.gaussians.method import GaussianMethod
from chronoscene.gaussians.model import SHAPES, opacities_of, scales_of
from chronoscene.gaussians.trainer import Due
from chronoscene.methods import TrainingSet, View
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.drawing import Splats, camera_centre_tensor
from chronoscene.training.schedules import log_linear
from chronoscene.training.spherical_harmonics import MAX_DEGREE, NUM_BASES, basis

_PHOTO = "photo."
"""Prefix of the tensors that a finished model does without."""


class GaussianInTheWild(GaussianMethod):
    """Static Gaussians in the colours that a network makes of features read from a photo.

    Source: Zhang et al., "Gaussian in the Wild", ECCV 2024. README.md beside this file says what
    differs on purpose.
    """

    name = "gs-w"
    config_class = GaussianInTheWildConfig
    trainer_class = WildTrainer
    config: GaussianInTheWildConfig
    model: WildModel
    trainer: WildTrainer | None

    def make_model(self, parameters: dict[str, Tensor], train: TrainingSet, seed: int) -> WildModel:
        config, means = self.config, parameters["means"]
        networks = Networks(
            encoder=config.encoder,
            map_channels=config.map_channels,
            width=config.width,
            frequencies=config.frequencies,
            position_unit=config.position_unit,
            from_constant=config.start_from_points,
        )
        coordinates = start_coordinates(means, float(config.box_pixels or 1), seed)
        tensors = start_networks(networks, seed)
        return WildModel(
            parameters | {COORDINATES: coordinates},
            {name: tensor.to(means.device) for name, tensor in tensors.items()},
            networks=networks,
        )

    def extended_model(self, train: TrainingSet) -> WildModel:
        """Gaussians keep what they read from photos of earlier periods, which are gone."""
        model, read = self.model, self._read_periods().detach()
        return replace(model, parameters=model.parameters | {EARLIER: read}, period_features=None)

    def restore_model(self, tensors: dict[str, Tensor]) -> WildModel:
        features = tensors.pop("period_features")
        return WildModel(
            {name: tensor for name, tensor in tensors.items() if name in SHAPES},
            {name: tensor for name, tensor in tensors.items() if name not in SHAPES},
            sh_degree=self.meta["sh_degree"],
            networks=Networks(**self.meta["networks"]),
            period_features=features,
        )

    def learning_rates(self, due: Due) -> Mapping[str, float]:
        config = self.config
        progress = due.moment / config.schedule_length
        cnn = log_linear(progress, config.cnn_lr_initial, config.cnn_lr_final)
        rates = {n: cnn if n.startswith(_PHOTO) else config.network_lr for n in self.model.shared}
        coordinates = log_linear(progress, config.coordinate_lr_initial, config.coordinate_lr_final)
        return {**super().learning_rates(due), **rates, COORDINATES: coordinates}

    def splats(self, view: View, period: float, appearance_period: float) -> Splats:
        self._read_periods()
        with one_thread():
            return super().splats(view, period, appearance_period)

    def static_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        """Spherical harmonics that fit the colours of the views best, each view as much as others.

        They are held near the constant colour where views are few, as `bake` does.
        """
        model, p = self.model, self.model.parameters
        device, features = p["means"].device, self._read_periods()[:, int(period)]
        rows = torch.arange(len(model), device=device)
        normal = torch.zeros(len(model), NUM_BASES, NUM_BASES, device=device)
        moments = torch.zeros(len(model), NUM_BASES, 3, device=device)
        for view in views:
            centre = camera_centre_tensor(view, device)
            with one_thread():
                colors = model.colors(centre, rows, features)
            offsets = p["means"] - centre
            values = basis(torch.nn.functional.normalize(offsets), MAX_DEGREE)
            normal += values[:, :, None] * values[:, None]
            moments += values[:, :, None] * (colors - 0.5)[:, None]
        normal.diagonal(dim1=1, dim2=2)[:, 1:] += RIDGE * len(views)
        harmonics = torch.linalg.solve(normal, moments)
        scales, opacities = scales_of(p["log_scales"]), opacities_of(p["logit_opacities"])
        tensors = (p["means"], p["quats"], scales, opacities, harmonics)
        return GaussianCloud(*(tensor.cpu().contiguous().numpy() for tensor in tensors))

    def stored_tensors(self) -> dict[str, Tensor]:
        """Tensors that views are rendered from: no photo and no network that reads one is kept."""
        model, features = self.model, self._read_periods()
        kept = {k: v for k, v in model.shared.items() if not k.startswith(_PHOTO)}
        groups = {name: model.parameters[name] for name in SHAPES}
        return groups | kept | {"period_features": features}

    def permute(self, order: NDArray[np.int64]) -> None:
        super().permute(order)
        self.model.period_features = self._read_periods()[torch.from_numpy(order)]

    def save(self, folder: Path) -> None:
        self.meta["networks"] = asdict(self.model.networks)
        super().save(folder)

    def _read_periods(self) -> Tensor:
        """The features of the periods, read again where the model has changed since."""
        if self.model.period_features is None:
            assert self.trainer is not None
            self.model.period_features = self.trainer.period_features()
        return self.model.period_features
