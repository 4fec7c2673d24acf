"""Base class of the methods with anchors."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.baking import bake
from chronoscene.anchors.blocks import count_sharing, own_blocks, pack_blocks, unpack_blocks
from chronoscene.anchors.config import HEADS, AnchorConfig
from chronoscene.anchors.contribution import pack_offsets, unpack_offsets
from chronoscene.anchors.density import initial_anchors, resolve_voxel_size
from chronoscene.anchors.model import FIXED, LAYERS, PER_ANCHOR, AnchorLayout, AnchorModel
from chronoscene.anchors.trainer import AnchorTrainer
from chronoscene.errors import CheckpointError
from chronoscene.methods import PeriodSharing, TrainingSet, View
from chronoscene.rasterizer import Rasterization
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.checkpoint import META_FILE, TENSOR_FILE
from chronoscene.training.device_memory import device_memory
from chronoscene.training.drawing import Splats, draw
from chronoscene.training.method import SplattingMethod
from chronoscene.training.periods import period_weights, with_new_periods
from chronoscene.training.points import finite_rows


class AnchorMethod(SplattingMethod):
    """Base class of methods with anchors; a subclass has a name, a layout and a model."""

    primitive = "anchors"
    model_class: ClassVar[type[AnchorModel]] = AnchorModel
    config: AnchorConfig
    trainer: AnchorTrainer | None

    def layout(self, train: TrainingSet) -> AnchorLayout:
        """Return the sizes and rules of the model."""
        return AnchorLayout.of(self.config, train.num_periods)

    @property
    def merge_share(self) -> float:
        """Share by which the loss may rise where periods come to share blocks; 0: none."""
        return 0.0

    @property
    def period_decay(self) -> float:
        """Decay of blocks towards the mean of their anchor, in learning rates per view."""
        return 0.0

    def feature_rows(self, train: TrainingSet) -> NDArray[np.int64]:
        """Return the row of the varying features of each training view; here its period. [V]"""
        return np.array([view.period for view in train.views])

    def rates(self, extent: float) -> dict[str, tuple[float, float]]:
        """Return start and end of the learning rate of every tensor, by its name in the model."""
        config, (start, end) = self.config, self.config.offset_lr
        rates = {
            "offsets": (start * extent, end * extent),
            "features": config.feature_lr,
            "blocks": config.feature_lr,
            "log_scales": config.scaling_lr,
        }
        for head in HEADS:
            rates |= {f"{head}.{layer}": getattr(config, f"{head}_lr") for layer in LAYERS}
        return rates

    def weights(self, period: float) -> NDArray[np.float32]:
        """Return the weights of the varying features; here by their periods. [T]"""
        return period_weights(period, self.num_periods)

    def extended_table(self, table: Tensor, count: int) -> Tensor:
        """Extend global features to another training set. [R, G] -> [count, G]

        Here those of a new period are copies of the last one's.
        """
        return with_new_periods(table, count)

    @property
    def model(self) -> AnchorModel:
        """Tensors, up to date; there are none before `setup` or `load`."""
        return self._model if self.trainer is None else self.trainer.snapshot()

    @property
    def num_periods(self) -> int:
        """Number of periods; asks for no tensors, which `model` brings up to date at every use."""
        return self._model.layout.num_periods

    def start(self, train: TrainingSet, *, seed: int, device: str) -> AnchorTrainer:
        config = self.config
        points = train.points[finite_rows(train.points)].astype(np.float64)
        scale = train.training_from_world.scale
        size = resolve_voxel_size(
            points, config.voxel_size, config.voxel_unit, training_from_world=scale
        )
        anchors, size = initial_anchors(
            points, size, origin=config.voxel_origin, limit=config.max_initial_anchors
        )
        layout, generator = self.layout(train), torch.Generator().manual_seed(seed)
        self._model = self.model_class.start(layout, config, anchors, generator).to(device)
        self.meta["voxel_size"] = size
        return self._make_trainer(train, seed)

    def extend(self, train: TrainingSet) -> None:
        """Train the anchors there are further: schedules, density control and moments begin anew.

        The features of a new period start as copies of the last one's, and no periods share any.
        Its sparse points are not used.
        """
        assert self.trainer is not None, "setup comes first"
        layout, model, seed = self.layout(train), self.model, self.trainer.seed
        periods = layout.num_periods
        generator = np.random.default_rng((seed, 3, periods))
        tensors = model.tensors() | model.longer_global(layout.global_dim, generator)
        tensors = {name: tensor.detach() for name, tensor in tensors.items()}
        if layout.period_dim:
            rows = with_new_periods(tensors["block_rows"].T, periods).T.contiguous()
            tensors["blocks"] = tensors["blocks"][rows].flatten(0, 1)
            tensors["block_rows"] = own_blocks(len(rows), periods).to(rows)
        tensors["global_features"] = self.extended_table(tensors["global_features"], periods)
        self._model = self.model_class.from_tensors(layout, tensors)
        self.go_on(train, self._make_trainer(train, seed))

    def _make_trainer(self, train: TrainingSet, seed: int) -> AnchorTrainer:
        self.meta["layout"] = dataclasses.asdict(self._model.layout)
        return AnchorTrainer(
            self.config,
            self._model,
            train,
            voxel_size=self.meta["voxel_size"],
            seed=seed,
            rates=self.rates(self.extent(train)),
            feature_rows=self.feature_rows(train),
            merge_share=self.merge_share,
            period_decay=self.period_decay,
        )

    def device_memory(self, points: int, periods: int, pixels: int) -> tuple[int, dict[str, int]]:
        config, layout = self.config, AnchorLayout.of(self.config, periods)
        features = layout.base_dim + periods * layout.period_dim
        numbers = 3 * layout.offsets + features + 6
        count = config.max_anchors or points
        return count, device_memory(count, numbers, layout.offsets, pixels)

    def splats(self, view: View, period: float, appearance_period: float) -> Splats:
        model = self.model
        seen = model.seen_from(view)
        splats, places = model.decode_active(self._weights(period), *seen)
        if appearance_period == period:
            return splats
        others = model.decode(self._weights(appearance_period), *seen)
        return splats._replace(colors=others.colors[places])

    def _weights(self, period: float) -> Tensor:
        return torch.from_numpy(self.weights(period)).to(self._model.device)

    def static_gaussians(self, period: float, views: Sequence[View]) -> GaussianCloud:
        return bake(self.model, self._weights(period), views)

    def draw_splats(self, splats: Splats, view: View, *, plain: bool = False) -> Rasterization:
        layout = self._model.layout
        return draw(
            splats,
            view,
            self.background,
            near_plane=layout.near_plane,
            antialiased=layout.antialiased and not plain,
            render_depth=True,
        )

    def stored_tensors(self) -> dict[str, Tensor]:
        return pack_blocks(pack_offsets(self.model.tensors()))

    def sharing(self) -> PeriodSharing | None:
        """Count what periods share; None for one period, or without features that vary."""
        model, exposure = self.model, self.exposure()
        layout = model.layout
        if layout.num_periods == 1 or not layout.period_dim:
            return None
        anchors, alone = count_sharing(model.block_rows)
        common = int(anchors[0])
        partly = (len(model.blocks) - common - int(alone.sum())) * layout.period_dim
        further = layout.global_dim + (0 if exposure is None else exposure[0].numel())
        own = tuple((alone * layout.period_dim + further).tolist())
        shared = self.size().parameters - sum(own) - partly
        return PeriodSharing(tuple(anchors.tolist()), own, partly, shared)

    def permute(self, order: NDArray[np.int64]) -> None:
        rows, tensors = torch.from_numpy(order), self._model.tensors()
        for name in {*FIXED, *PER_ANCHOR} & tensors.keys():
            tensors[name] = tensors[name][rows]
        self._model = self.model_class.from_tensors(self._model.layout, tensors)

    def restore(self, folder: Path, tensors: dict[str, Tensor], device: str) -> None:
        if not isinstance(self.meta.get("layout"), dict):
            raise CheckpointError(
                folder / META_FILE,
                expected="the key layout",
                found="none",
                todo="the model is of another version: train again",
            )
        layout = AnchorLayout.from_meta(self.meta["layout"])
        self.config = dataclasses.replace(self.config, near_plane=layout.near_plane)
        try:
            unpacked = unpack_offsets(tensors, layout.offsets)
            restored = unpack_blocks(unpacked, layout.num_periods)
            self._model = self.model_class.from_tensors(layout, restored)
        except KeyError as error:
            raise CheckpointError(
                folder / TENSOR_FILE,
                expected=f"the tensor {error}",
                found=", ".join(sorted(tensors)),
                todo="the model is of another version: train again",
            ) from error
