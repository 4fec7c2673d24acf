"""One training step of a model with anchors.

Every schedule follows the progress of the training. Gradients come from kernels that reduce in a
fixed order or from elementwise torch, and random numbers only from the seed, so a seed gives the
same bytes for any number of threads.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.direct import learn_directly
from chronoscene.anchors.model import AnchorModel
from chronoscene.anchors.optimizer import AnchorOptimizer, SeenAnchors
from chronoscene.anchors.rounds import DensityControl, DrawnView
from chronoscene.kernels.side_by_side import side_by_side
from chronoscene.methods import StepReport, TrainingSet, TrainingView
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.checkpoint import TrainingState, check_views, parts
from chronoscene.training.devices import has_kernels
from chronoscene.training.drawing import Chance, camera_centre_tensor, draw_in_training
from chronoscene.training.exposure import Exposure
from chronoscene.training.gradients import BackwardPass, collect_gradients, joined, judge_gradients
from chronoscene.training.losses import mean_volume, training_loss
from chronoscene.training.optimizers.adam import Pace
from chronoscene.training.optimizers.summing import Part
from chronoscene.training.schedules import learning_rates
from chronoscene.training.sparse_depth import DepthTarget, SparseDepth
from chronoscene.training.views import (
    PhotoSizes,
    PhotosOnDevice,
    ViewSampler,
    count_views,
    is_due,
    views_of_step,
)

_DECAY_INTERVAL = 10
"""Views between two decays, which read the blocks of all anchors."""

Learned = tuple[BackwardPass, Tensor, Tensor, RasterInfo]
"""Outcome, places [L] and opacities [L] of the Gaussians that are switched on, and details of the
rasterization."""


class Drawn(NamedTuple):
    """A view that is due in a step, with its photo."""

    number: int
    """Number of the view."""
    chance: Chance
    """Decides on what is random."""
    photo: Tensor
    """uint8 [H, W, 3]"""
    mask: Tensor | None
    """bool [H, W]"""
    target: DepthTarget | None = None
    """Depths to compare with."""


class ViewPass(NamedTuple):
    """Outcome of one view of a step."""

    result: BackwardPass
    drawn: DrawnView
    seen: SeenAnchors
    """Has the gradients."""
    exposure: list[Part]
    """Has those of `Exposure`."""


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
    period_decay: float = 0.0
    """Decay of blocks towards the mean of their anchor, in learning rates per view."""

    def __post_init__(self) -> None:
        model, train, seed = self.model, self.train, self.seed
        self.views = count_views(self.config.views_per_step)
        self.optimizer = AnchorOptimizer(model, self.rates, Pace(self.views))
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
        # Others, as of an earlier stage of a sequential training, are not to change.
        self._periods = torch.from_numpy(np.unique(self.feature_rows)).to(model.device)
        self._one_period = torch.ones(1, device=model.device)
        self.background = torch.from_numpy(train.background).to(model.device)
        self.sampler = ViewSampler(len(train.views), seed, train.expect)
        self.sizes = PhotoSizes(train, self.config.half_size_share)
        self._use(train)
        self.exposure = Exposure(self.config.exposure, train, model.device, Pace(self.views))

    def _use(self, train: TrainingSet) -> None:
        """Learn from the same photos in other sizes from now on."""
        self.train = train
        self.photos = PhotosOnDevice(train, self.model.device)
        self.sparse_depth = SparseDepth(self.config.depth_weight, train, self.model.device)

    def step(self, index: int, progress: float) -> StepReport:
        """Render training views, learn from them, and grow and prune where a round is due.

        The views of a step all meet the model as it was before. Each has threads of its own, unless
        it learns an exposure or on a GPU; their gradients are added in the order of the views. With
        one view to a step, a round drops its gradients of anchors, as the official code does; with
        several, which would cost so many views, the anchors move before the round.
        """
        if (train := self.sizes.change(progress)) is not None:
            self._use(train)
        count = views_of_step(self.views, index, progress)
        done = self._progress_after(index, count, progress)
        due = [self._draw(progress) for _ in range(count)]
        if has_kernels(self.model.anchors) and not self.exposure.tables:
            passes = side_by_side(self._learn, due)
        else:
            passes = [self._learn(drawn) for drawn in due]
        learned = [view for view in passes if view.result.skipped is None]
        for view in learned:
            self.density.collect(view.drawn, view.result.loss, done)
        if learned:
            self.optimizer.learn_from([view.seen for view in learned])
            self.exposure.use([view.exposure for view in learned])
        if self.views == 1:
            resized = self.density.round(index, count, done)
            self._update(learned, done, resized=resized)
        else:
            self._update(learned, done, resized=False)
            self.density.round(index, count, done)
        if is_due(index, count, _DECAY_INTERVAL):
            self._decay(done)
        self.optimizer.adam.zero_grad()
        result = joined([view.result for view in passes])
        return StepReport(result.loss, len(self.model), result.skipped, result.not_finite, count)

    def _update(self, learned: Sequence[ViewPass], done: float, *, resized: bool) -> None:
        """Do a step of all optimisers, unless no view counts."""
        if learned:
            rates = learning_rates(self.rates, done, cooldown=self.config.cooldown)
            self.optimizer.step(rates, resized=resized)
            self.exposure.step(done)

    def _decay(self, done: float) -> None:
        """Let the periods of each anchor become more alike, where that is asked for."""
        if not self.period_decay or not self.model.layout.period_dim or len(self._periods) < 2:
            return
        rates = {"blocks": self.rates["blocks"]}
        rate = learning_rates(rates, done, cooldown=self.config.cooldown)["blocks"]
        self.optimizer.decay_blocks(
            self._periods, min(self.period_decay * rate * _DECAY_INTERVAL, 1.0)
        )

    def _progress_after(self, index: int, count: int, progress: float) -> float:
        """Return the share of the training that is over once this step is done."""
        return progress * (index + count) / index if index > 0 else count / self.config.iterations

    def _draw(self, progress: float) -> Drawn:
        """Draw the next view and load its photo; arguments as in `step`."""
        number = self.sampler.next()
        photo, mask = self.photos.photo(number), self.photos.mask(number)
        drawn = self.sampler.drawn
        target = self.sparse_depth.target(number, drawn)
        return Drawn(number, Chance(self.seed, drawn, progress), photo, mask, target)

    def _learn(self, due: Drawn) -> ViewPass:
        """Draw a training view and collect gradients; the model and its optimiser stay."""
        view, row = self.train.views[due.number], int(self.feature_rows[due.number])
        visible = self.model.visible(view)
        seen = self.optimizer.seen(visible, row)
        plain = due.mask is None and not self.exposure.tables
        learned = self._learn_directly(seen, due) if plain else None
        if learned is None:
            learned = self._learn_by_autograd(seen, due)
        result, positions, opacities, info = learned
        drawn = DrawnView(
            view, row, due.mask, visible, positions, opacities, info, seen.model.blocks.grad
        )
        return ViewPass(result, drawn, seen, self.exposure.parts())

    def _decode_arguments(
        self, seen: AnchorModel, view: TrainingView
    ) -> tuple[Tensor, Tensor, None]:
        """Return period weights and camera centre; all anchors are to be decoded."""
        return self._one_period, camera_centre_tensor(view, seen.device), None

    def _learn_directly(self, seen: SeenAnchors, due: Drawn) -> Learned | None:
        """Learn from a view without autograd; None where that does not apply."""
        config, view = self.config, self.train.views[due.number]
        with torch.no_grad():
            inputs = seen.model.decode_inputs(*self._decode_arguments(seen.model, view))
        found = learn_directly(
            seen.model, inputs, view, due.photo, self.background, config, due.chance, due.target
        )
        if found is None:
            return None
        result = judge_gradients(found.loss, found.info, seen.gradients())
        return result, found.positions, found.splats.opacities, found.info

    def _learn_by_autograd(self, seen: SeenAnchors, due: Drawn) -> Learned:
        config, view = self.config, self.train.views[due.number]
        splats, positions = seen.model.decode_active(*self._decode_arguments(seen.model, view))
        target = due.target
        raster = draw_in_training(
            splats, view, self.background, config, due.chance, render_depth=target is not None
        )
        loss = training_loss(
            raster, due.photo, due.mask, number=due.number, exposure=self.exposure, config=config
        )
        if target is not None:
            loss = loss + target.term_of(raster)
        if config.scale_weight:
            loss = loss + config.scale_weight * mean_volume(splats.scales, splats.opacities)
        result = collect_gradients(
            loss, raster.info, lambda: seen.gradients() | self.exposure.gradients(), due.mask
        )
        return result, positions, splats.opacities, raster.info

    def state(self) -> TrainingState:
        """Return everything that the steps to come depend on."""
        tensors, values = self.density.state()
        tensors |= self.optimizer.state()
        tensors |= {f"exposure.{name}": tensor for name, tensor in self.exposure.state().items()}
        values |= {"views_drawn": self.sampler.drawn, "views_per_step": self.views}
        return TrainingState(tensors, values)

    @torch.no_grad()
    def load_state(self, state: TrainingState) -> None:
        """Go on from what `state` gave, in a trainer that was made alike."""
        check_views(state, self.views)
        self.optimizer.load_state(state.tensors)
        self.exposure.load_state(parts(state.tensors, "exposure"))
        self.density.load_state(state.tensors, state.values)
        self.sampler.drawn = state.values["views_drawn"]

    def snapshot(self) -> AnchorModel:
        """Return the model as it is now."""
        return self.optimizer.snapshot()
