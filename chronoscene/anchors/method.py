"""What methods with anchors have in common as plug-ins: start, train, render, save, load."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.model import AnchorLayout, AnchorModel, draw_model
from chronoscene.anchors.trainer import AfterUpdate, AnchorTrainer, learning_rates
from chronoscene.anchors.voxels import (
    finite_points,
    initial_anchors,
    initial_log_scales,
    resolve_voxel_size,
)
from chronoscene.errors import CheckpointError
from chronoscene.methods import MethodSize, Prediction, StepReport, TrainingSet, View
from chronoscene.rasterizer.types import Rasterization
from chronoscene.training.checkpoint import build_meta, load_tensors, save_tensors


class AnchorMethod:
    """Base of the methods; a subclass names itself and says what its layout adds.

    Args:
        config: Options of the method.
    """

    name: ClassVar[str]
    version: ClassVar[str] = "1"

    def __init__(self, config: AnchorConfig) -> None:
        self.config = config
        self._model: AnchorModel | None = None
        self._trainer: AnchorTrainer | None = None
        self._background = torch.zeros(3)
        self._meta: dict[str, Any] = {}

    def layout(self, num_periods: int) -> AnchorLayout:
        """Lengths and rules of the model."""
        return AnchorLayout.of(self.config, num_periods)

    def rates(self, camera_extent: float) -> dict[str, tuple[float, float]]:
        """Learning rates by tensor name."""
        return learning_rates(self.config, camera_extent)

    def weights(self, period: float) -> NDArray[np.float32]:
        """Weights of the periods' features. [T]"""
        raise NotImplementedError

    def after_update(self) -> AfterUpdate | None:
        """What a method does to the features after each optimiser step; here nothing."""
        return None

    def stored_tensors(self) -> dict[str, Tensor]:
        """The model as it goes to disk, by name."""
        return self.model.tensors()

    def restored_tensors(
        self, stored: dict[str, Tensor], layout: AnchorLayout
    ) -> dict[str, Tensor]:
        """Inverse of `stored_tensors`."""
        return stored

    @property
    def model(self) -> AnchorModel:
        """The tensors, up to date; there are none before `setup` or `load`."""
        assert self._model is not None, "setup or load comes first"
        return self._model if self._trainer is None else self._trainer.snapshot()

    @property
    def num_periods(self) -> int:
        """Of the model; asks for no tensors, which `model` brings up to date at every use."""
        assert self._model is not None, "setup or load comes first"
        return self._model.layout.num_periods

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        """Build anchors, MLPs and optimiser from a training set."""
        config = self.config
        points = finite_points(train.points[:: config.point_stride])
        size = resolve_voxel_size(
            points,
            config.voxel_size,
            config.voxel_unit,
            training_from_world=train.training_from_world.scale,
        )
        anchors, size = initial_anchors(
            points, size, origin=config.voxel_origin, limit=config.max_initial_anchors
        )
        generator = torch.Generator().manual_seed(seed)
        self._start(train, anchors, generator, device)
        self._trainer = AnchorTrainer(
            config,
            self.model,
            train,
            voxel_size=size,
            seed=seed,
            rates=self.rates(train.camera_extent),
            after_update=self.after_update(),
        )
        self._meta = build_meta(
            self.name,
            self.version,
            config,
            training_from_world=train.training_from_world,
            num_periods=train.num_periods,
            layout=dataclasses.asdict(self.model.layout),
            background=train.background.tolist(),
            voxel_size=size,
        )

    def _start(
        self,
        train: TrainingSet,
        anchors: NDArray[np.float32],
        generator: torch.Generator,
        device: str,
    ) -> None:
        config = self.config
        self._background = torch.from_numpy(train.background).to(device)
        self._model = AnchorModel.start(
            self.layout(train.num_periods),
            anchors,
            initial_log_scales(anchors),
            generator,
            feature_init=config.feature_init,
            feature_init_scale=config.feature_init_scale,
            global_init=getattr(config, "global_init", "zero"),
        ).to(device)

    def step(self, index: int, progress: float) -> StepReport:
        """Learn from one training view."""
        assert self._trainer is not None, "setup comes first"
        return self._trainer.step(index, progress)

    def render(self, view: View, period: float) -> Prediction:
        """Render a view as of a period."""
        return self._draw(view, self.weights(period))

    def _draw(
        self,
        view: View,
        geometry: NDArray[np.float32],
        appearance: NDArray[np.float32] | None = None,
    ) -> Prediction:
        model = self.model
        colors = None if appearance is None else torch.from_numpy(appearance).to(model.device)
        weights = torch.from_numpy(geometry).to(model.device)
        return _prediction(draw_model(model, view, self._background, weights, colors))

    def save(self, folder: Path) -> None:
        """Write the model; the optimiser's state is not kept."""
        save_tensors(folder, self.stored_tensors(), self._meta)

    def load(self, folder: Path, *, device: str) -> None:
        """Read a model; its own layout and options count, not those given to the constructor."""
        tensors, meta = load_tensors(folder, device=device, method=self.name)
        if not isinstance(meta.get("layout"), dict):
            raise CheckpointError(
                folder / "model.json", expected="a layout", found="none", todo="train again"
            )
        layout = AnchorLayout.from_meta(meta["layout"])
        try:
            self._model = AnchorModel.from_tensors(layout, self.restored_tensors(tensors, layout))
        except KeyError as error:
            raise CheckpointError(
                folder / "model.safetensors",
                expected=f"the tensor {error}",
                found=", ".join(sorted(tensors)),
                todo="the model is of another version: train again",
            ) from error
        self._background = torch.tensor(meta["background"], dtype=torch.float32, device=device)
        self._trainer, self._meta = None, meta

    def size(self) -> MethodSize:
        """Anchors, and all stored numbers."""
        tensors = self.stored_tensors()
        return MethodSize(len(tensors["anchors"]), sum(t.numel() for t in tensors.values()))


def _prediction(raster: Rasterization) -> Prediction:
    assert raster.depths is not None
    images: Sequence[Tensor] = (raster.image[0], raster.alphas[0, ..., 0], raster.depths[0, ..., 0])
    rgb, alpha, depth = (image.detach().cpu().numpy() for image in images)
    return Prediction(rgb=rgb.clip(0.0, 1.0), alpha=alpha, depth=depth)
