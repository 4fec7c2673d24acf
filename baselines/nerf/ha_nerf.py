"""Ha-NeRF as a plug-in: the light of a photo is what an encoder sees in it."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.nerf.config import HaNerfConfig
from baselines.nerf.encoder import encode_photos, initial_encoder, small_photo
from baselines.nerf.method import LitNerf
from chronoscene.fields.method import Drawn
from chronoscene.fields.network import named
from chronoscene.fields.rays import PixelPool, Rays
from chronoscene.methods import StepReport, TrainingSet, View

_BATCH = 64  # Photos that are encoded at a time
_LEAST_MASK_WEIGHT, _MASK_DECAY = 0.006, 1e-3  # As in the official command lines; per step


class HaNerf(LitNerf):
    """NeRF with the light of each photo from an encoder, and masks of transient things.

    A rendered view has the mean code of the training photos of its period; the model stores these
    means, and no photo.

    Source: Chen et al. 2022, "Hallucinated Neural Radiance Fields in the Wild".
    """

    name = "ha-nerf"
    config: HaNerfConfig
    photos: Tensor | None = None
    """Small training photos, -1..1; None for a loaded model. [V, 3, S, S]"""

    def make_pool(self, train: TrainingSet) -> PixelPool:
        pool = super().make_pool(train)
        indices = range(len(train.views))
        self.photos = self._small((train.load_image(i), train.load_mask(i)) for i in indices)
        self._means: Tensor | None = None
        return pool

    def _small(
        self, photos: Iterable[tuple[NDArray[np.uint8], NDArray[np.bool_] | None]]
    ) -> Tensor:
        """Return what the encoder is given of photos and their masks. [V, 3, S, S]"""
        small = np.stack([small_photo(*photo, self.config.photo_size) for photo in photos])
        values = small.astype(np.float32).transpose(0, 3, 1, 2) / np.float32(127.5) - 1
        return self.tensor(values)

    def initial(self, train: TrainingSet, generator: torch.Generator) -> dict[str, Tensor]:
        params = super().initial(train, generator)
        if self.config.appearance == "none":
            return params
        layers = initial_encoder(self.config.channels, self.config.appearance_size, generator)
        return params | named("encoder", layers)

    def begin(self, params: Any) -> None:
        super().begin(params)
        self._means = None

    def step(self, index: int, progress: float) -> StepReport:
        report = super().step(index, progress)
        self._means = None
        return report

    def draw_rays(self, generator: np.random.Generator) -> Rays:
        """Draw rays of some photos, since each of these has to be encoded."""
        seen = np.flatnonzero(self.pool.counts)
        count = min(self.config.photos, len(seen))
        return self.pool.draw(
            generator, self.num_rays, np.sort(generator.choice(seen, count, replace=False))
        )

    def lights(self, views: Tensor) -> Tensor:
        assert self.photos is not None
        found, places = views.unique(return_inverse=True)
        photos = self.photos.index_select(0, found)
        self._codes = encode_photos(photos, self.network.layers("encoder"))
        return self._codes.index_select(0, places)

    @torch.no_grad()
    def light_of(
        self, view: View, period: float, photo: NDArray[np.uint8], known: NDArray[np.bool_]
    ) -> Tensor:
        """Encode the known pixels of a photo; nothing is fitted."""
        del view, period
        return encode_photos(self._small([(photo, known)]), self.network.layers("encoder"))

    def mean_light(self, weights: NDArray[np.float32]) -> Tensor:
        return (self.tensor(weights)[:, None] * self.period_lights()).sum(0, keepdim=True)

    @torch.no_grad()
    def period_lights(self) -> Tensor:
        """Return the mean code of the training photos of each period. [T, A]

        Of all photos, where a period has none.
        """
        if self.photos is None:
            return self.network.params["period_lights"]
        if self._means is None:
            layers = self.network.layers("encoder")
            codes = torch.cat([encode_photos(part, layers) for part in self.photos.split(_BATCH)])
            periods = self.pool.periods
            own = [codes[periods == i] for i in range(int(self.meta["num_periods"]))]
            chosen = [part if len(part) else codes for part in own]
            self._means = torch.stack([part.sum(0) / len(part) for part in chosen])
        return self._means

    def loss(self, drawn: Drawn, rays: Rays, progress: float) -> Tensor:
        loss = super().loss(drawn, rays, progress)
        if self.config.appearance == "none":
            return loss
        return loss + self.config.code_weight * self._codes.square().mean()

    def rates(self, progress: float) -> dict[str, float]:
        rates = super().rates(progress)
        share = self.config.encoder_rate / self.config.network_rate
        return {n: share * r if n.startswith("encoder") else r for n, r in rates.items()}

    def mask_weight(self, progress: float) -> float:
        """Return the weight of the squared mask; masks are cheaper and cheaper."""
        steps = progress * self.config.iterations
        return max(_LEAST_MASK_WEIGHT, self.config.mask_weight * math.exp(-_MASK_DECAY * steps))

    def stored(self) -> dict[str, Tensor]:
        stored = super().stored()
        if self.config.appearance != "none":
            stored["period_lights"] = self.period_lights()
        return stored


class HaNerfT(HaNerf):
    """Ha-NeRF whose colours know the time."""

    name = "ha-nerf-t"
