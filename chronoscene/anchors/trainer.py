"""One training step of a model with anchors.

Every schedule follows the progress of the training. Gradients come from kernels that reduce in a
fixed order or from elementwise torch, and random numbers only from the seed, so a seed gives the
same bytes for any number of threads.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.direct import learn_directly
from chronoscene.anchors.model import AnchorModel
from chronoscene.anchors.optimizer import AnchorOptimizer
from chronoscene.anchors.rounds import DensityControl, DrawnView
from chronoscene.methods import StepReport, TrainingSet, TrainingView
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.checkpoint import TrainingState, parts
from chronoscene.training.devices import to_device
from chronoscene.training.drawing import camera_centre_tensor, draw_in_training, step_background
from chronoscene.training.exposure import Exposure
from chronoscene.training.gradients import (
    BackwardPass,
    collect_gradients,
    judge_gradients,
    mask_tensor,
)
from chronoscene.training.losses import mean_volume, training_loss
from chronoscene.training.schedules import learning_rates
from chronoscene.training.views import ViewSampler

Learned = tuple[BackwardPass, Tensor, Tensor, RasterInfo]
"""Outcome, places [L] and opacities [L] of the Gaussians that are switched on, and details of the
rasterization."""


@dataclass(eq=False)
class AnchorTrainer:
    """Training of a model on the views of a training set."""

    config: AnchorConfig
    model: AnchorModel
    """Trained in place; `snapshot` gives its present state."""
    train: TrainingSet
    _: KW_ONLY
    voxel_size: float
    """Smallest growth cell in training units."""
    seed: int
    """Seed of all random choices."""
    rates: Mapping[str, tuple[float, float]]
    """Learning rates by tensor name."""
    feature_rows: NDArray[np.int64]
    """Row of the varying features of each view, mostly its period. [V]"""
    merge_share: float = 0.0
    """See `DensityControl`."""

    def __post_init__(self) -> None:
        model, train, seed = self.model, self.train, self.seed
        self.optimizer = AnchorOptimizer(model, self.rates)
        self.rates = {name: self.rates[name] for name in self.optimizer.trained}
        self.density = DensityControl(
            self.config,
            self.optimizer,
            train,
            voxel_size=self.voxel_size,
            feature_rows=self.feature_rows,
            merge_share=self.merge_share,
            generator=np.random.default_rng((seed, 1)),
        )
        self._one_period = torch.ones(1, device=model.device)
        self.background = torch.from_numpy(train.background).to(model.device)
        self.sampler = ViewSampler(len(train.views), seed, train.expect)
        self.exposure = Exposure(self.config.exposure, train, model.device)

    def step(self, index: int, progress: float) -> StepReport:
        """Render one training view, learn from it, and grow and prune where a round is due."""
        done = self._progress_after(index, progress)
        result = self._learn(self.sampler.next(), done)
        resized = self.density.round(index, done)
        if result.skipped is None:
            rates = learning_rates(self.rates, done, cooldown=self.config.cooldown)
            self.optimizer.step(rates, resized=resized)
            self.exposure.step(done)
        self.optimizer.adam.zero_grad()
        return StepReport(result.loss, len(self.model), result.skipped, result.not_finite)

    def _progress_after(self, index: int, progress: float) -> float:
        """Return the share of the training that is over once this step is done."""
        return progress * (index + 1) / index if index > 0 else 1.0 / self.config.iterations

    def _learn(self, number: int, done: float) -> BackwardPass:
        """Draw a training view, and collect gradients and statistics."""
        view, row = self.train.views[number], int(self.feature_rows[number])
        photo = to_device(self.train.load_image(number), self.model.device)
        mask = mask_tensor(self.train, number, self.model.device)
        visible = self.model.visible(view)
        seen = self.optimizer.seen(visible, row)
        plain = mask is None and not self.exposure.tables
        learned = self._learn_directly(seen, view, row, photo) if plain else None
        if learned is None:
            learned = self._learn_by_autograd(seen, number, photo, mask)
        result, positions, opacities, info = learned
        if result.skipped is None:
            drawn = DrawnView(view, row, mask, visible, positions, opacities, info)
            self.density.collect(drawn, result.loss, done)
        return result

    def _decode_arguments(self, seen: AnchorModel, view: TrainingView) -> tuple[Tensor, ...]:
        """Return period weights, camera centre and the numbers of all anchors."""
        everything = torch.arange(len(seen), device=seen.device)
        return self._one_period, camera_centre_tensor(view, seen.device), everything

    def _learn_directly(
        self, seen: AnchorModel, view: TrainingView, row: int, photo: Tensor
    ) -> Learned | None:
        """Learn from a view without autograd; None where that does not apply."""
        with torch.no_grad():
            inputs = seen.decode_inputs(*self._decode_arguments(seen, view))
        number = self.sampler.drawn
        background = step_background(self.background, self.config, seed=self.seed, number=number)
        found = learn_directly(seen, inputs, view, photo, background, self.config)
        if found is None:
            return None
        if (table := self.model.global_features).numel():
            table.grad = torch.zeros_like(table)
            table.grad[row] = found.global_gradient[0]
        result = judge_gradients(found.loss, found.info, self.optimizer.gradients())
        return result, found.positions, found.splats.opacities, found.info

    def _learn_by_autograd(
        self, seen: AnchorModel, number: int, photo: Tensor, mask: Tensor | None
    ) -> Learned:
        config, view = self.config, self.train.views[number]
        splats, positions = seen.decode_active(*self._decode_arguments(seen, view))
        raster = draw_in_training(
            splats, view, self.background, config, seed=self.seed, number=self.sampler.drawn
        )
        loss = training_loss(
            raster, photo, mask, number=number, exposure=self.exposure, config=config
        )
        if config.scale_weight:
            loss = loss + config.scale_weight * mean_volume(splats.scales, splats.opacities)
        result = collect_gradients(
            loss, raster.info, lambda: self.optimizer.gradients() | self.exposure.gradients(), mask
        )
        return result, positions, splats.opacities, raster.info

    def state(self) -> TrainingState:
        """Return everything that the steps to come depend on."""
        tensors, values = self.density.state()
        tensors |= self.optimizer.state()
        tensors |= {f"exposure.{name}": tensor for name, tensor in self.exposure.state().items()}
        return TrainingState(tensors, values | {"views_drawn": self.sampler.drawn})

    @torch.no_grad()
    def load_state(self, state: TrainingState) -> None:
        """Go on from what `state` gave, in a trainer that was made alike."""
        self.optimizer.load_state(state.tensors)
        self.exposure.load_state(parts(state.tensors, "exposure"))
        self.density.load_state(state.tensors, state.values)
        self.sampler.drawn = state.values["views_drawn"]

    def snapshot(self) -> AnchorModel:
        """Return the model as it is now."""
        return self.optimizer.snapshot()
