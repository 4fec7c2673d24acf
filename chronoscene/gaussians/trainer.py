"""One training step of explicit Gaussians, and what is due at which step.

Source: Kerbl et al. 2023 (3D Gaussian Splatting), with the schedule of the released code.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.density import (
    GradientStatistics,
    densify,
    reset_opacities,
    scatter_in_space,
)
from chronoscene.gaussians.mcmc import make_generator, noise, relocate
from chronoscene.gaussians.model import GaussianModel
from chronoscene.methods import StepReport, TrainingSet
from chronoscene.rasterizer import Rasterization
from chronoscene.training.checkpoint import TrainingState, check_views, parts
from chronoscene.training.drawing import Chance, Splats, draw_in_training
from chronoscene.training.exposure import Exposure
from chronoscene.training.gradients import BackwardPass, collect_gradients, joined
from chronoscene.training.losses import steady_mean, training_loss
from chronoscene.training.optimizers.adam import Adam, Pace
from chronoscene.training.optimizers.summing import Part, add_gradients
from chronoscene.training.photometric import photometric_loss
from chronoscene.training.schedules import cooled, log_linear
from chronoscene.training.sparse_depth import SparseDepth
from chronoscene.training.views import (
    PhotoSizes,
    PhotosOnDevice,
    ViewSampler,
    count_views,
    is_due,
    views_of_step,
)

# Keep random choices of a kind apart from those of others with the same seed
_SPLIT_STREAM = 1
_PLACE_STREAM = 4
_NOISE_STREAM = 5


@dataclass(frozen=True, slots=True)
class Due:
    """Actions and settings of one training step."""

    moment: int
    """Iteration of the schedule, from 1; of several views, the first."""
    progress: float
    """Share of the training that is over."""
    sh_degree: int
    position_lr: float
    """Learning rate of positions, not yet multiplied by the extent of the cameras."""
    collect: bool
    """True if the gradients of this step count for the next round of densification."""
    densify: bool
    prune_large: bool
    reset: bool


class Timeline:
    """Turns steps and progress into what is due, each event once.

    Args:
        config: Has the moments.
        begin: Index of the step at which moments begin.
    """

    def __init__(self, config: GaussianConfig, begin: int = 0) -> None:
        self.config, self.begin = config, begin
        self.last_moment = 0
        """Moment of the latest step; 0 before the first."""

    def moment(self, index: int, progress: float) -> int:
        """Iteration of the schedule, from 1; arguments as in `chronoscene.methods.Method.step`."""
        config = self.config
        done = round(progress * config.schedule_length) if config.stretch else index - self.begin
        return done + 1

    def at(self, index: int, progress: float, views: int = 1) -> Due:
        """Return what is due at a step of some views; arguments as in `Method.step`."""
        config, moment = self.config, self.moment(index, progress)
        resets, resets_before = (m // config.reset_interval for m in (moment, self.last_moment))
        self.last_moment = moment
        growing = moment < config.densify_until
        adaptive = config.densification == "adaptive"
        densify = growing and moment > config.densify_from
        decay = moment / config.schedule_length  # beyond 1 after the end of the schedule
        return Due(
            moment=moment,
            progress=progress,
            sh_degree=min(config.sh_degree, moment // config.sh_interval),
            position_lr=log_linear(decay, config.position_lr_initial, config.position_lr_final),
            collect=growing and adaptive,
            densify=densify and is_due(index, views, config.densify_interval),
            prune_large=moment > config.prune_large_from,
            # A squeezed schedule jumps over moments and may pass a multiple of the interval.
            reset=growing and adaptive and resets > resets_before,
        )


@dataclass(eq=False)
class GaussianTrainer:
    """Trains a model on the views of a training set."""

    config: GaussianConfig
    model: GaussianModel
    """Trained in place."""
    train: TrainingSet
    _: KW_ONLY
    extent: float
    """Length that rates of positions and bounds of scales are multiples of."""
    seed: int
    """Seed of all random choices."""
    background: Tensor
    """[3]"""
    learning_rates: Callable[[Due], Mapping[str, float]]
    """Gives the learning rate of each tensor of the model at a step, before any cooldown."""

    timeline_class: ClassVar[type[Timeline]] = Timeline
    scatter = staticmethod(scatter_in_space)
    """Function that splits Gaussians, a `density.Scatter`."""

    def __post_init__(self) -> None:
        self.views = count_views(self.config.views_per_step)
        self.pace = Pace(self.views)
        self.timeline = self.timeline_class(self.config)
        self.begin_views()
        self.begin()

    def begin_views(self) -> None:
        """Begin with the views of the training set, and without exposures."""
        self.sampler = ViewSampler(len(self.train.views), self.seed, self.train.expect)
        device = self.background.device
        self.exposure = Exposure(self.config.exposure, self.train, device, self.pace)
        self.sizes = PhotoSizes(self.train, self.config.half_size_share)
        self._use(self.train)

    def _use(self, train: TrainingSet) -> None:
        """Learn from the same photos in other sizes from now on."""
        device = self.background.device
        self.train = train
        self.photos = PhotosOnDevice(train, device)
        self.sparse_depth = SparseDepth(self.config.depth_weight, train, device)

    def begin(self) -> None:
        """Forget the moments of the optimiser and the gradients seen for densification."""
        tensors = {n: t.requires_grad_() for n, t in self.model.tensors().items()}
        self.optimizer = Adam(tensors, self.pace)
        self.statistics = GradientStatistics(len(self.model), self.background.device)

    def step(self, index: int, progress: float) -> StepReport:
        """Render training views, learn from them, and change the set of Gaussians where due.

        The views of a step are drawn one after the other, from the model as it was before, and
        their gradients are added. With one view to a step, densification drops its gradients, as
        the released code does; with several, which would cost so many views, it comes after Adam.
        """
        if (train := self.sizes.change(progress)) is not None:
            self._use(train)
        count = views_of_step(self.views, index - self.timeline.begin, progress)
        due = self.timeline.at(index, progress, count)
        # Higher than what is due at the start of a training that goes on with a model.
        self.model.sh_degree = max(due.sh_degree, self.model.sh_degree)
        total: dict[str, Tensor] = {}
        exposures: list[list[Part]] = []
        passes = [self._learn(due, total, exposures) for _ in range(count)]
        result = joined(passes)
        for name, value in self.optimizer.params.items():
            value.grad = total.get(name)
        if exposures:
            self.exposure.use(exposures)
            self.exposure.step(progress)
        if due.densify and self.views == 1:
            self._densify(index, prune_large=due.prune_large)
        self._update(due)
        if due.densify and self.views > 1:
            self._densify(index, prune_large=due.prune_large)
        if not result.skipped:
            self._move_at_random(index, due)
        return StepReport(result.loss, len(self.model), result.skipped, result.not_finite, count)

    def _learn(
        self, due: Due, total: dict[str, Tensor], exposures: list[list[Part]]
    ) -> BackwardPass:
        """Render the next training view, and add its gradients and statistics unless skipped."""
        number = self.sampler.next()
        view = self.train.views[number]
        splats = self.splats(number)
        chance = Chance(self.seed, self.sampler.drawn, due.progress)
        target = self.sparse_depth.target(number, self.sampler.drawn)
        raster = draw_in_training(
            splats, view, self.background, self.config, chance, render_depth=target is not None
        )
        mask = self.photos.mask(number)
        terms = self._regulariser(splats)
        if target is not None:
            terms = terms + target.term_of(raster)
        self.optimizer.zero_grad()
        result = collect_gradients(
            self.loss(raster, number, mask) + terms,
            raster.info,
            lambda: self.optimizer.gradients() | self.exposure.gradients(),
            mask,
        )
        if not result.skipped:
            add_gradients(total, self.optimizer.gradients())
            exposures.append(self.exposure.parts())
            if due.collect:
                self.statistics.add(raster.info, view.width, view.height, mask)
        return result

    def state(self) -> TrainingState:
        """Everything that the steps to come depend on; methods may add to it."""
        tensors = {f"model.{name}": tensor for name, tensor in self.model.tensors().items()}
        tensors |= {f"adam.{name}": tensor for name, tensor in self.optimizer.state().items()}
        tensors |= {f"exposure.{name}": tensor for name, tensor in self.exposure.state().items()}
        tensors |= {"statistics.sums": self.statistics.sums}
        tensors |= {"statistics.views": self.statistics.views}
        values = {
            "views_drawn": self.sampler.drawn,
            "last_moment": self.timeline.last_moment,
            "sh_degree": self.model.sh_degree,
            "views_per_step": self.views,
        }
        return TrainingState(tensors, values)

    @torch.no_grad()
    def load_state(self, state: TrainingState) -> None:
        """Go on from what `state` gave, in a trainer that was made alike."""
        check_views(state, self.views)
        model, statistics = self.model, self.statistics
        stored, adam, counts = (parts(state.tensors, n) for n in ("model", "adam", "statistics"))
        for name, tensor in model.parameters.items():
            model.parameters[name] = stored[name].to(tensor, copy=True).requires_grad_()
        for name, tensor in model.shared.items():
            tensor.copy_(stored[name])
        self.optimizer = Adam(model.tensors(), self.pace)
        self.optimizer.load_state(adam)
        self.exposure.load_state(parts(state.tensors, "exposure"))
        statistics.sums = counts["sums"].to(statistics.sums)
        statistics.views = counts["views"].to(statistics.views)
        self.sampler.drawn = state.values["views_drawn"]
        self.timeline.last_moment = state.values["last_moment"]
        model.sh_degree = state.values["sh_degree"]

    def splats(self, number: int) -> Splats:
        """Gaussians to draw in training view ``number``; methods may look at its photo."""
        view = self.train.views[number]
        return self.model.splats(view, view.period)

    def loss(self, raster: Rasterization, number: int, mask: Tensor | None) -> Tensor:
        """Photometric loss against the photo of view ``number``; methods may add terms."""
        return training_loss(
            raster,
            self.photos.photo(number),
            mask,
            number=number,
            exposure=self.exposure,
            config=self.config,
            compare=self.compare,
        )

    def compare(self, image: Tensor, photo: Tensor, mask: Tensor | None) -> Tensor:
        """Photometric loss; arguments as of `photometric_loss`."""
        return photometric_loss(image, photo, ssim_weight=self.config.ssim_weight, mask=mask)

    def _regulariser(self, splats: Splats) -> Tensor | float:
        """Terms of the loss that keep Gaussians faint and small, so that they can relocate."""
        config = self.config
        if config.densification != "mcmc":
            return 0.0
        opacity, scale = steady_mean(splats.opacities), steady_mean(splats.scales)
        return config.mcmc_opacity_weight * opacity + config.mcmc_scale_weight * scale

    @torch.no_grad()
    def _move_at_random(self, index: int, due: Due) -> None:
        """The random part of a step of the kind mcmc."""
        if self.config.densification != "mcmc":
            return
        # The noise of several steps adds up to this factor times that of one.
        parameters, rate = self.model.parameters, self.pace.rate * self._rates(due)["means"]
        generator = make_generator(self.background.device, self.seed, _NOISE_STREAM, index)
        parameters["means"].add_(noise(parameters, rate, self.config, generator))

    @torch.no_grad()
    def _densify(self, index: int, *, prune_large: bool) -> None:
        """Change the set of Gaussians; their gradients of this step are dropped."""
        if self.config.densification == "mcmc":
            generator = make_generator(self.background.device, self.seed, _PLACE_STREAM, index)
            result = relocate(self.model.parameters, self.config, generator)
        else:
            result = densify(
                self.model.parameters,
                self.statistics.mean(),
                extent=self.extent,
                prune_large=prune_large,
                config=self.config,
                generator=np.random.default_rng((self.seed, _SPLIT_STREAM, index)),
                scatter=self.scatter,
            )
        for name, rows in result.new.items():
            self.optimizer.keep(name, result.keep)
            self.model.parameters[name] = self.optimizer.extend(name, rows)
        self.statistics = GradientStatistics(len(self.model), self.background.device)

    @torch.no_grad()
    def _update(self, due: Due) -> None:
        """Adam's step for every tensor that has a gradient, and the opacity reset."""
        skip: tuple[str, ...] = ()
        if due.reset:
            logits = self.model.parameters["logit_opacities"]
            logits.copy_(reset_opacities(logits, self.config.reset_opacity))
            self.optimizer.reset_moments("logit_opacities")
            skip = ("logit_opacities",)
        self.optimizer.step(self._rates(due), skip=skip)

    def _rates(self, due: Due) -> dict[str, float]:
        return cooled(self.learning_rates(due), due.progress, self.config.cooldown)
