"""CLNeRF as a plug-in."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.continual_nerf.config import ContinualConfig
from chronoscene.fields.method import Drawn, FieldMethod
from chronoscene.fields.network import Codes
from chronoscene.fields.rays import PixelPool, Rays
from chronoscene.methods import StepReport, TrainingSet, TrainingView
from chronoscene.training.periods import with_new_periods

_RESERVOIR = 1_002  # Numbers of random draws, after the seed
_FRESH = 1_003
_CHARBONNIER = 1e-6  # Added to the square

LoadImage = Callable[[int], NDArray[np.uint8]]
LoadMask = Callable[[int], NDArray[np.bool_] | None]


@dataclass
class Memory:
    """Remains of earlier periods: cameras, and a few photos."""

    views: tuple[TrainingView, ...] = ()
    photos: dict[int, tuple[NDArray[np.uint8], NDArray[np.bool_] | None]] = field(
        default_factory=dict
    )
    """Kept photos with their masks, by the number of their view."""

    def add(self, train: TrainingSet, size: int, seed: int) -> None:
        """Take in the views of a period; each photo so far is kept with equal probability.

        Source: Vitter 1985, "Random Sampling with a Reservoir", algorithm R.
        """
        slots = list(self.photos)
        for i in range(len(train.views)):
            number = len(self.views) + i
            if len(slots) < size:
                slots.append(number)
                continue
            place = int(np.random.default_rng((seed, _RESERVOIR, number)).integers(number + 1))
            if place < size:
                slots[place] = number
        first = len(self.views)
        self.views += train.views
        photos = {}
        for number in slots:
            if number in self.photos:
                photos[number] = self.photos[number]
            else:
                mask = train.load_mask(number - first)
                photos[number] = train.load_image(number - first).copy(), mask
        self.photos = photos


class CLNeRF(FieldMethod):
    """A hash grid with codes of each period for geometry and appearance; learned period by period.

    Source: Cai and Müller 2023, "CLNeRF: Continual Learning Meets NeRF". README.md beside this file
    says what differs on purpose.
    """

    name = "clnerf"
    config: ContinualConfig

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        super().setup(train, seed=seed, device=device)
        self.memory = Memory()
        self.replayed = 0
        self.train = train
        self._fresh: dict[str, Tensor] | None = None

    def initial(self, train: TrainingSet, generator: torch.Generator) -> dict[str, Tensor]:
        config, periods = self.config, train.num_periods
        sizes = config.geometry_size, config.appearance_size
        params = self.network_class.initial(config, *sizes, generator)
        for name, size in zip(("geometry", "appearance"), sizes, strict=True):
            params[name] = 0.1 * torch.randn(periods, size, generator=generator)
        return params

    def codes(self, rays: Rays) -> Codes:
        periods = self.tensor(self.pool.periods[rays.views])
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
        squares = (drawn.rgb - self.tensor(rays.colors)).square()
        old = self.tensor((rays.views < self.replayed).astype(np.float32))[:, None]
        weight = (1 + math.cos(math.pi * (1 + progress))) / 2
        robust = weight * torch.sqrt(squares + _CHARBONNIER)
        return loss + (old * (robust - squares)).mean()

    def extend(self, train: TrainingSet) -> None:
        """Render or keep what is to be shown again, then go on with a further period."""
        self.memory.add(self.train, self.config.buffer, self.seed)
        self.train = train
        self.pool = self._pool_with_replay(train)
        self.occupancy.extend(train.num_periods)
        self.meta["num_periods"] = train.num_periods
        params = dict(self.network.params)
        for name in ("geometry", "appearance"):
            params[name] = with_new_periods(params[name], train.num_periods)
        self.begin(params)
        if self.config.start == "fresh":
            # Only from the first step on, so that until then the model shows what it did.
            generator = torch.Generator().manual_seed(self.seed + _FRESH * train.num_periods)
            self._fresh = self.initial(train, generator)

    def step(self, index: int, progress: float) -> StepReport:
        if self._fresh is not None and index == 0:
            self.begin(self._fresh)
        self._fresh = None
        return super().step(index, progress)

    def _pool_with_replay(self, train: TrainingSet) -> PixelPool:
        """Pixels of the new photos, and of what is replayed."""
        old = self._replayed()
        self.replayed = len(old)
        views = (*(self.memory.views[i] for i in old), *train.views)
        photos = self.memory.photos

        def load_image(i: int) -> NDArray[np.uint8]:
            if i >= len(old):
                return train.load_image(i - len(old))
            if old[i] in photos:
                return photos[old[i]][0]
            view = self.memory.views[old[i]]
            return np.rint(255 * self.render(view, float(view.period)).rgb).astype(np.uint8)

        def load_mask(i: int) -> NDArray[np.bool_] | None:
            if i >= len(old):
                return train.load_mask(i - len(old))
            return photos[old[i]][1] if old[i] in photos else None

        return PixelPool(views, load_image, load_mask, seed=self.seed)

    def _replayed(self) -> list[int]:
        """Numbers of the earlier views that are shown again."""
        if self.config.replay == "none":
            return []
        every = range(len(self.memory.views))
        return [i for i in every if self.config.replay == "rendered" or i in self.memory.photos]


class MEILNeRF(CLNeRF):
    """The same with the replay loss of MEIL-NeRF, as the repository of CLNeRF has it.

    Source: Chung et al. 2022, "MEIL-NeRF: Memory-Efficient Incremental Learning of Neural Radiance
    Fields"; its learned generator of rays is not part of that code, nor of this.
    """

    name = "meil-nerf"
