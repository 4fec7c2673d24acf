"""NeRF and what was made of it for photos of many days, as plug-ins."""

from __future__ import annotations

from copy import copy
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.nerf.config import NerfConfig
from baselines.nerf.network import ContentNetwork, NerfNetwork
from baselines.nerf.time import FIRST_WIDTH, step_code
from chronoscene.fields.method import Drawn, FieldMethod
from chronoscene.fields.mlp import equal_groups, initial_layers, mlp
from chronoscene.fields.network import Codes, FieldNetwork, frequency_code, named
from chronoscene.fields.rays import PixelPool, Rays
from chronoscene.methods import TrainingSet, TrainingView, View
from chronoscene.training.optimizers.adam import Adam
from chronoscene.training.periods import period_weights

_PIXEL_FREQUENCIES = 10
_MASK_CODE = 128
_MASK_HIDDEN = 64
_FIT_STEPS, _FIT_RAYS, _FIT_RATE = 60, 256, 0.02
"""Steps, rays of a step and learning rate of the fit of a light to a test photo."""


class Nerf(FieldMethod):
    """Static density; colours of the place, and by its flags of the time and of the photo.

    A rendered view has the mean of the light of its period's training photos, so no test photo has
    a code. README.md beside this file says what differs on purpose from each paper.
    """

    name = "nerf"
    network_class: ClassVar[type[FieldNetwork]] = NerfNetwork
    geometry_varies = False
    config: NerfConfig
    network: NerfNetwork
    light: Tensor | None = None
    """Code of the light of rendered views; None for the mean of their period. [1, A]"""

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        super().setup(train, seed=seed, device=device)
        self.meta["image_periods"] = [view.period for view in train.views]

    def initial(self, train: TrainingSet, generator: torch.Generator) -> dict[str, Tensor]:
        config, images = self.config, len(train.views)
        network = self.network_class
        assert issubclass(network, NerfNetwork)
        params = network.begin(config, generator)
        if config.time == "steps":
            params["step_centres"] = torch.rand(config.time_steps, generator=generator)
            params["step_widths"] = torch.full((config.time_steps,), FIRST_WIDTH)
        if config.appearance == "image":
            params["light_codes"] = _codes(images, config.appearance_size, generator)
        if config.transient == "density":
            params["transient_codes"] = _codes(images, config.transient_size, generator)
        if config.transient == "mask":
            params["mask_codes"] = _codes(images, _MASK_CODE, generator)
            widths = 2 * (1 + 2 * _PIXEL_FREQUENCIES) + _MASK_CODE, *(4 * [_MASK_HIDDEN]), 1
            params |= named("mask", initial_layers(widths, generator))
        return params

    def time_code(self, times: Tensor) -> Tensor:
        """Return the code of times 0..1. [R] -> [R, E]"""
        params = self.network.params
        if self.config.time == "steps":
            return step_code(times, params["step_centres"], params["step_widths"])
        if self.config.time == "frequencies":
            return frequency_code(times[:, None], self.config.time_frequencies)
        return torch.zeros(len(times), 0, device=times.device)

    def times(self, periods: Tensor) -> Tensor:
        """Return the times of periods, 0 at the first and 1 at the last. [R]"""
        last = max(int(self.meta["num_periods"]) - 1, 1)
        return (periods.double() / last).float()

    def codes(self, rays: Rays) -> Codes:
        params = self.network.params
        periods = torch.arange(int(self.meta["num_periods"]), device=self.device)
        every = self.time_code(self.times(periods))
        color = every.index_select(0, self.pool.periods[rays.views])
        if self.config.appearance != "none":
            color = torch.cat((color, self.lights(rays.views)), dim=1)
        geometry = color[:, :0]
        if "transient_codes" in params:
            geometry = params["transient_codes"].index_select(0, rays.views)
        return Codes(geometry, color)

    def lights(self, views: Tensor) -> Tensor:
        """Return the code of the light of each photo. [R] -> [R, A]"""
        return self.network.params["light_codes"].index_select(0, views)

    def view_codes(self, geometry_period: float, appearance_period: float) -> Codes:
        """Return the codes of a view; no transient things."""
        weights = period_weights(appearance_period, int(self.meta["num_periods"]))
        period = torch.full((1,), appearance_period, dtype=torch.float64, device=self.device)
        color = self.time_code(self.times(period))
        if self.config.appearance != "none":
            light = self.mean_light(weights) if self.light is None else self.light
            color = torch.cat((color, light), dim=1)
        return Codes(color[:, :0], color)

    def geometry_code(self, period: int) -> Tensor:
        del period
        return torch.zeros(1, 0, device=self.device)

    def mean_light(self, weights: NDArray[np.float32]) -> Tensor:
        """Return the mean code of the photos of periods with weights. [T] -> [1, A]

        Of all photos, where these periods have none.
        """
        periods = np.array(self.meta["image_periods"])
        counts = np.bincount(periods, minlength=len(weights))
        own = (weights / np.maximum(counts, 1))[periods].astype(np.float32)
        shares = self.tensor(own if own.any() else np.ones_like(own))
        lights = self.network.params["light_codes"]
        return (shares[:, None] * lights).sum(0, keepdim=True) / shares.sum()

    def loss(self, drawn: Drawn, rays: Rays, progress: float) -> Tensor:
        target = rays.colors
        squares = (drawn.rgb - target).square()
        if self.config.transient == "density":
            return self._uncertain_loss(squares, drawn)
        loss = super().loss(drawn, rays, progress)
        if self.config.transient == "mask":
            mask = self._masks(rays)
            kept = 1 - mask
            loss = 0.5 * (kept * squares).mean()
            loss = loss + self.mask_weight(progress) * mask.square().mean()
            kept = kept.detach()
        else:
            kept = torch.ones_like(squares[:, :1])
        if self.config.time == "steps":
            clear = (1 - drawn.opacities)[:, None] * self.background
            content = drawn.values[:, 3:6] + clear
            loss = loss + self.config.content_weight * (kept * (content - target).square()).mean()
        return loss

    def mask_weight(self, progress: float) -> float:
        """Return the weight of the squared mask."""
        del progress
        return self.config.mask_weight

    def _uncertain_loss(self, squares: Tensor, drawn: Drawn) -> Tensor:
        """Error over the uncertainty of each ray, as in NeRF-W, equation 13."""
        beta = drawn.values[:, 3] + self.config.least_uncertainty
        error = (squares / (2 * beta.square())[:, None]).mean()
        return (
            error
            + 3
            + torch.log(beta).mean()
            + self.config.transient_weight * drawn.values[:, 4].mean()
        )

    def _masks(self, rays: Rays) -> Tensor:
        """Return how much of what rays show is in their photo alone, 0..1. [R, 1]"""
        codes = self.network.params["mask_codes"].index_select(0, rays.views)
        places = frequency_code(rays.pixels, _PIXEL_FREQUENCIES)
        groups = equal_groups(len(places), 1, self.device)
        return mlp(places, codes, groups, self.network.layers("mask"), "sigmoid")


class NerfT(Nerf):
    """NeRF whose colours know the time."""

    name = "nerf-t"


class LitNerf(Nerf):
    """Base class where each photo has a light of its own."""

    def fitted_to(
        self, view: View, period: float, photo: NDArray[np.uint8], known: NDArray[np.bool_]
    ) -> LitNerf:
        """Return the model with the light that renders the known pixels of a photo best."""
        fitted = copy(self)
        if self.config.appearance != "none" and known.any():
            fitted.light = self.light_of(view, period, photo, known)
        return fitted

    def light_of(
        self, view: View, period: float, photo: NDArray[np.uint8], known: NDArray[np.bool_]
    ) -> Tensor:
        """Fit the code of a photo's light to its known pixels, from the mean of its period."""
        taken = TrainingView(view.K, view.width, view.height, view.cam_from_world, "", 0)
        pool = PixelPool([taken], lambda _: photo, lambda _: known, device=self.device)
        model, generator = copy(self), np.random.default_rng(self.seed)
        weights = period_weights(period, int(self.meta["num_periods"]))
        model.light = self.mean_light(weights).detach().clone().requires_grad_()
        optimizer = Adam({"light": model.light})
        for _ in range(_FIT_STEPS):
            rays = pool.draw(generator, _FIT_RAYS)
            middle = torch.full_like(rays.depths, 0.5)
            samples = self.march(rays, rays.views + self.nearest_period(period), middle)
            codes = model.view_codes(period, period)
            wide = Codes(*(code.expand(len(middle), -1) for code in codes))
            drawn, _ = self.draw(rays, samples, wide)
            error = (drawn.rgb - rays.colors).square().mean()
            (model.light.grad,) = torch.autograd.grad(error, model.light)
            optimizer.step({"light": _FIT_RATE})
        return model.light.detach()


class NerfW(LitNerf):
    """NeRF-W: light of each photo, transient things with uncertainty.

    Source: Martin-Brualla et al. 2021, "NeRF in the Wild".
    """

    name = "nerf-w"


class NerfWT(NerfW):
    """NeRF-W whose colours know the time."""

    name = "nerf-w-t"


class NeuSC(LitNerf):
    """NeuSC: content in steps of the time, light of each photo, masks of transient things.

    Source: Lin et al. 2023, "Neural Scene Chronology".
    """

    name = "neusc"
    network_class = ContentNetwork


def _codes(count: int, size: int, generator: torch.Generator) -> Tensor:
    return 0.1 * torch.randn(count, size, generator=generator)
