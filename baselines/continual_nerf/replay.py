"""Continual learning of a field: earlier periods are shown again, as photos or as renderings."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.continual_nerf.config import ReplayConfig
from chronoscene.fields.method import FieldMethod
from chronoscene.fields.rays import PixelPool
from chronoscene.methods import StepReport, TrainingSet, TrainingView

_RESERVOIR = 1_002  # Numbers of random draws, after the seed
_FRESH = 1_003


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


class ReplayMethod(FieldMethod):
    """Base class of fields that are learned period by period."""

    config: ReplayConfig

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        super().setup(train, seed=seed, device=device)
        self.memory = Memory()
        self.replayed = 0
        self.train = train
        self._fresh: dict[str, Tensor] | None = None

    @abstractmethod
    def extended(self, train: TrainingSet) -> dict[str, Tensor]:
        """Return the tensors of the field with what a further period needs."""

    def replayed_view(self, view: TrainingView) -> TrainingView:
        """Return an earlier view as it is shown again."""
        return view

    def extend(self, train: TrainingSet) -> None:
        """Render or keep what is to be shown again, then go on with a further period."""
        self.memory.add(self.train, self.config.buffer, self.seed)
        self.train = train
        self.pool = self._pool_with_replay(train)
        self.occupancy.extend(train.num_periods)
        self.meta["num_periods"] = train.num_periods
        self.begin(self.extended(train))
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
        views = (*(self.replayed_view(self.memory.views[i]) for i in old), *train.views)
        photos = self.memory.photos

        def load_image(i: int) -> NDArray[np.uint8]:
            if i >= len(old):
                return train.load_image(i - len(old))
            if old[i] in photos:
                return photos[old[i]][0]
            view = self.memory.views[old[i]]
            period = min(views[i].period, int(self.meta["num_periods"]) - 1)
            return np.rint(255 * self.render(view, float(period)).rgb).astype(np.uint8)

        def load_mask(i: int) -> NDArray[np.bool_] | None:
            if i >= len(old):
                return train.load_mask(i - len(old))
            return photos[old[i]][1] if old[i] in photos else None

        return PixelPool(views, load_image, load_mask, seed=self.seed, device=self.device)

    def _replayed(self) -> list[int]:
        """Numbers of the earlier views that are shown again."""
        if self.config.replay == "none":
            return []
        every = range(len(self.memory.views))
        return [i for i in every if self.config.replay == "rendered" or i in self.memory.photos]
