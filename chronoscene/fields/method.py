"""Base class of the methods that are radiance fields: training on rays of all views, rendering."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.errors import ShapeError
from chronoscene.fields.box import SceneBox, box_of, sensible_cells
from chronoscene.fields.compositing import STOP, Front, composite, visible
from chronoscene.fields.config import FieldConfig
from chronoscene.fields.marching import Samples, march
from chronoscene.fields.mlp import Groups, equal_groups, make_groups
from chronoscene.fields.network import Codes, FieldNetwork
from chronoscene.fields.occupancy import INTERVAL, Occupancy, start_occupancy
from chronoscene.fields.rays import PixelPool, Rays, view_rays
from chronoscene.fields.rows import part_rows
from chronoscene.methods import MethodSize, Prediction, StepReport, TrainingSet, View
from chronoscene.training import devices
from chronoscene.training.checkpoint import (
    MISFITS,
    TRAINING,
    check_finite,
    load_tensors,
    misfit,
    parts,
    save_tensors,
)
from chronoscene.training.devices import to_device
from chronoscene.training.optimizers.adam import Adam, all_finite
from chronoscene.training.periods import period_weights

_FIRST_RAYS, _FEWEST_RAYS = 256, 64
_PIXELS_PER_RAY = 64
_RENDERED_RAYS = 16_384  # At a time
_RENDERED_SAMPLES = 131_072  # At a time; each level of a grid is read once for all of them
_AT_A_TIME = 16  # Samples of a ray, at most, before it is asked whether it goes on
_STREAM = 1_000  # Number of the random draws of a step, after the seed
_GRIDS = ("inside", "outside")


class Drawn:
    """Outcome of some rays: sums along them, and what the loss needs besides."""

    def __init__(self, sums: Tensor, opacities: Tensor, background: Tensor) -> None:
        self.values = sums
        """[R, C]"""
        self.opacities = opacities
        """[R]"""
        self.rgb = sums[:, :3] + (1 - opacities)[:, None] * background
        """[R, 3]"""


class FieldMethod(ABC):
    """Base class that fulfils `chronoscene.methods.Method` for radiance fields.

    Steps draw rays of all views at once. A subclass says what the field is made of, and which codes
    the rays of a photo have.

    Args:
        config: Options of the method.
    """

    name: ClassVar[str]
    """Name on the command line."""
    version: ClassVar[str] = "1"
    """Version of the implementation; stored with every model."""
    geometry_varies: ClassVar[bool] = True
    """True if densities depend on the period, so that each has an occupancy grid of its own."""
    network_class: ClassVar[type[FieldNetwork]] = FieldNetwork

    def __init__(self, config: FieldConfig) -> None:
        self.config = config
        self.device = "cpu"
        self.seed = 0
        self.meta: dict[str, Any] = {}
        self.optimizer: Adam | None = None

    @abstractmethod
    def initial(self, train: TrainingSet, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw the tensors of a new field."""

    @abstractmethod
    def codes(self, rays: Rays) -> Codes:
        """Return the codes of rays of `pool`. [R, ...]"""

    @abstractmethod
    def view_codes(self, geometry_period: float, appearance_period: float) -> Codes:
        """Return the codes of a view that is rendered, in one row."""

    def geometry_code(self, period: int) -> Tensor:
        """Return the geometry code of a period, in one row."""
        return self.view_codes(period, period).geometry

    def loss(self, drawn: Drawn, rays: Rays, progress: float) -> Tensor:
        """Return what a step minimises: the squared error, and little for half-opaque rays."""
        error = (drawn.rgb - rays.colors).square().mean()
        opacities = drawn.opacities.clamp(1e-5, 1)
        entropy = -(opacities * torch.log(opacities)).mean()
        return error + self.config.opacity_weight * entropy

    # Training.

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        self.device, self.seed = device, seed
        self.background = torch.from_numpy(np.array(train.background, np.float32)).to(device)
        self.box = box_of(train)
        self.pool = self.make_pool(train)
        cells = min(self.config.cells, sensible_cells(train.views, self.box))
        grids = train.num_periods if self.geometry_varies else 1
        self.occupancy = start_occupancy(
            train, self.box, self.pool, grids, cells, self.config.spacing, device
        )
        self.meta = {
            "method": self.name,
            "version": self.version,
            "config": asdict(self.config),
            "training_from_world": train.training_from_world.to_matrix().tolist(),
            "num_periods": train.num_periods,
            "background": self.background.tolist(),
            "box": asdict(self.box),
            "cells": cells,
        }
        self.begin(self.initial(train, torch.Generator().manual_seed(seed)))

    def make_pool(self, train: TrainingSet) -> PixelPool:
        """Read the photos of a training set."""
        return PixelPool(
            train.views,
            train.load_image,
            train.load_mask,
            expect=train.expect,
            seed=self.seed,
            device=self.device,
        )

    def begin(self, params: Mapping[str, Tensor]) -> None:
        """Start to train tensors, by name."""
        leaves = {
            name: tensor.detach().to(self.device).contiguous().requires_grad_()
            for name, tensor in params.items()
        }
        self.network = self.network_class(self.config, leaves)
        self.optimizer = Adam(leaves)
        self.num_rays = min(_FIRST_RAYS, self.config.most_rays)

    def step(self, index: int, progress: float) -> StepReport:
        assert self.optimizer is not None, "setup comes first"
        generator = np.random.default_rng((self.seed, _STREAM, index))
        if index % INTERVAL == 0:
            self.occupancy.refresh(index, self.probe, generator)
        count, _ = self._primitives()
        if len(self.pool) == 0:
            return StepReport(0.0, count, "empty")
        rays = self.draw_rays(generator)
        jitter = devices.uniform(generator, (len(rays.views),), rays.depths)
        samples = self.march(rays, self.pool.periods[rays.views], jitter)
        if len(samples.lengths) == 0:
            return StepReport(0.0, count, "empty")
        drawn, _ = self.draw(rays, samples, self.codes(rays))
        loss = self.loss(drawn, rays, progress)
        self.optimizer.zero_grad()
        loss.backward()
        self._adapt_rays(len(samples.lengths))
        # What is not finite in a table comes from the networks behind it.
        gradients = self.optimizer.gradients().items()
        found = {name: grad for name, grad in gradients if not name.startswith("table")}
        found["loss"] = loss.detach()
        finite = all_finite(list(found.values())).to(found["loss"])
        value, sound = torch.stack((found["loss"], finite)).tolist()
        if not sound:
            wrong = tuple(name for name, tensor in found.items() if not all_finite([tensor]))
            return StepReport(value, count, "not finite", wrong)
        self.optimizer.step(self.rates(progress))
        return StepReport(value, count)

    def rates(self, progress: float) -> dict[str, float]:
        """Return the learning rate of each tensor: a cosine from 1 to the final share."""
        end = self.config.final_share
        share = end + (1 - end) * (1 + math.cos(math.pi * min(progress, 1.0))) / 2
        tables = {name for name in self.network.params if name.startswith("table")}
        return {
            name: share
            * (self.config.learning_rate if name in tables else self.config.network_rate)
            for name in self.network.params
        }

    def _adapt_rays(self, samples: int) -> None:
        """Draw as many rays in the next step as give the samples that are asked for."""
        wanted = self.num_rays * self.config.samples / samples
        # Slowly, as a step is only a sample of all rays.
        wanted = min(max(wanted, 0.8 * self.num_rays), 1.25 * self.num_rays)
        # No step needs a large part of all pixels.
        wanted = max(_FEWEST_RAYS, min(wanted, len(self.pool) // _PIXELS_PER_RAY))
        self.num_rays = min(int(wanted), self.config.most_rays)

    def draw_rays(self, generator: np.random.Generator) -> Rays:
        """Draw the rays of a step."""
        return self.pool.draw(generator, self.num_rays)

    # What rays meet.

    def tensor(self, array: NDArray[Any]) -> Tensor:
        """Copy an array to the device of the field."""
        return to_device(np.ascontiguousarray(array), self.device)

    def march(self, rays: Rays, periods: Tensor, jitter: Tensor) -> Samples:
        """Place samples on rays."""
        periods = periods.clamp_max(len(self.occupancy.grids[0]) - 1)
        origins = self.box.to_cube(rays.origins)
        fixed = self.occupancy.grids, self.box, self.occupancy.step, self.config.shells
        return march(origins, rays.directions, periods, jitter, *fixed)

    def draw(self, rays: Rays, samples: Samples, codes: Codes) -> tuple[Drawn, Tensor]:
        """Evaluate the field at samples and sum along the rays; returns mean distances, too."""
        if not torch.is_grad_enabled():
            return self._draw_until_opaque(rays, samples, codes)
        densities, values, lengths, distances, groups = self._seen(samples, rays.directions, codes)
        sums, opacities = composite(densities, values, lengths, groups)
        with torch.no_grad():
            reach, _ = composite(densities.detach(), distances[:, None], lengths, groups)
        return Drawn(sums, opacities, self.background), reach[:, 0]

    def _draw_until_opaque(
        self, rays: Rays, samples: Samples, codes: Codes
    ) -> tuple[Drawn, Tensor]:
        """Do the same from the camera on, each ray until nothing behind is seen; equal bits."""
        front, first = Front(len(rays.views), self.device), samples.groups.starts[:-1]
        counts, done = samples.groups.starts.diff(), 0
        going = counts.nonzero()[:, 0]
        while done == 0 or len(going):
            most = min(_AT_A_TIME, _RENDERED_SAMPLES // max(len(going), 1))
            taken = (counts[going] - done).clamp_max(most)
            groups = make_groups(torch.cat((taken.new_zeros(1), taken.cumsum(0))))
            places, lengths, distances = (
                part_rows(x, first[going] + done, groups) for x in samples[:3]
            )
            part = Samples(places, lengths, distances, groups)
            code, clear = Codes(*(code[going] for code in codes)), front.clear[going]
            densities, values, lengths, distances, groups = self._seen(
                part, rays.directions[going], code, clear
            )
            values = torch.cat((values, distances[:, None]), dim=1)
            front.add(going, densities, values, lengths, groups)
            done += most
            going = going[((front.clear[going] >= STOP) & (counts[going] > done)).nonzero()[:, 0]]
        return Drawn(front.sums[:, :-1], 1 - front.clear, self.background), front.sums[:, -1]

    def _seen(
        self, samples: Samples, directions: Tensor, codes: Codes, clear: Tensor | None = None
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Groups]:
        """Evaluate densities, and values where something is seen.

        What is hidden has no weight and no gradient, and is left out.

        Args:
            samples: Samples of some rays.
            directions: [R, 3]
            codes: [R, ...]
            clear: Transmittance before the first sample of each ray, if not 1. [R]

        Returns:
            Densities, values, lengths, distances and groups of the samples that are seen.
        """
        places, lengths, distances, groups = samples
        densities, features = self.network.density(places, groups, codes.geometry)
        seen = visible(densities, lengths, groups, clear)
        if len(seen.of_row) < len(places):
            every, first = (densities, features, places, lengths, distances), groups.starts[:-1]
            densities, features, places, lengths, distances = (
                part_rows(x, first, seen) for x in every
            )
            groups = seen
        values = self.network.values(features, places, groups, directions, codes.color)
        return densities, values, lengths, distances, groups

    @torch.no_grad()
    def probe(self, places: Tensor, period: int) -> Tensor:
        """Return the densities at contracted places in a period. [N]"""
        # Groups of a fixed size, so that there is work for all threads.
        groups = equal_groups(len(places), 1_024, self.device)
        code = self.geometry_code(period).expand(len(groups.starts) - 1, -1)
        return self.network.density(places, groups, code)[0]

    def render(self, view: View, period: float) -> Prediction:
        return self.render_split(view, geometry_period=period, appearance_period=period)

    @torch.no_grad()
    def render_split(
        self, view: View, *, geometry_period: float, appearance_period: float
    ) -> Prediction:
        """Render densities of one period in the colours of another."""
        count = view.width * view.height
        codes = self.view_codes(geometry_period, appearance_period)
        period = self.nearest_period(geometry_period)
        parts = []
        for first in range(0, count, _RENDERED_RAYS):
            pixels = torch.arange(first, min(first + _RENDERED_RAYS, count), device=self.device)
            rays = view_rays(view, pixels)
            middle = torch.full_like(rays.depths, 0.5)
            samples = self.march(rays, torch.full_like(pixels, period), middle)
            wide = Codes(*(code.expand(len(pixels), -1) for code in codes))
            drawn, reach = self.draw(rays, samples, wide)
            seen = drawn.opacities
            distance = torch.where(seen > 0, reach / seen.clamp_min(1e-9), 0)
            depth = distance * rays.depths * self.box.half
            parts.append(torch.cat((drawn.rgb, seen[:, None], depth[:, None]), dim=1))
        found = torch.cat(parts).cpu().numpy().reshape(view.height, view.width, 5)
        rgb, alpha = found[..., :3].clip(0, 1), found[..., 3].clip(0, 1)
        return Prediction(rgb=rgb.copy(), alpha=alpha.copy(), depth=found[..., 4].copy())

    def nearest_period(self, period: float) -> int:
        """Return the whole period whose occupied cells serve a fractional one."""
        weights = period_weights(period, int(self.meta["num_periods"]))
        return int(weights.argmax())

    def mixed(self, rows: Tensor, period: float) -> Tensor:
        """Mix rows of periods, one-hot at whole ones. [T, E] -> [1, E]"""
        weights = period_weights(period, len(rows))
        kept = np.flatnonzero(weights)
        return torch.stack([float(weights[i]) * rows[i] for i in kept]).sum(0, keepdim=True)

    # Files.

    def stored(self) -> dict[str, Tensor]:
        """Return the tensors of the model: the field, and a bit for each cell."""
        grids = {
            f"occupied.{name}": torch.from_numpy(np.packbits(grid.cpu().numpy()))
            for name, grid in zip(_GRIDS, self.occupancy.grids, strict=True)
        }
        return {**self.network.params, **grids}

    def save(self, folder: Path) -> None:
        """Write the model; the state of the optimiser is not stored."""
        save_tensors(folder, self.stored(), self.meta)

    def load(self, folder: Path, *, device: str) -> None:
        """Read a model; what is stored with it takes precedence over the options given here."""
        tensors, self.meta = load_tensors(folder, device=device, method=self.name)
        check_finite(folder, tensors)
        self.device = device
        try:
            self.config = type(self.config)(**self.meta["config"])
            self.background = torch.tensor(self.meta["background"], device=device)
            box = self.meta["box"]
            self.box = SceneBox(tuple(box["centre"]), box["half"], tuple(box["sides"]))
            grids = {name: tensors.pop(f"occupied.{name}").cpu().numpy() for name in _GRIDS}
            periods = self.meta["num_periods"] if self.geometry_varies else 1
            self.occupancy = Occupancy.restore(
                periods, self.meta["cells"], self.config.spacing, grids, device
            )
            self.network = self.network_class(self.config, tensors)
        except MISFITS as error:
            raise misfit(folder, "tensors and a description that fit together", error) from error
        self.optimizer = None

    def save_training(self, folder: Path) -> None:
        assert self.optimizer is not None, "setup comes first"
        tensors = {f"param.{name}": tensor for name, tensor in self.network.params.items()}
        tensors |= {f"adam.{name}": tensor for name, tensor in self.optimizer.state().items()}
        for i, name in enumerate(_GRIDS):
            tensors[f"density.{name}"] = self.occupancy.densities[i]
            tensors[f"grid.{name}"] = self.occupancy.grids[i]
        meta = {"method": self.name, "version": self.version, "rays": self.num_rays}
        save_tensors(folder, tensors, meta, stem=TRAINING)

    def load_training(self, folder: Path) -> None:
        assert self.optimizer is not None, "setup comes first"
        tensors, meta = load_tensors(folder, method=self.name, stem=TRAINING)
        try:
            self.begin(parts(tensors, "param"))
            self.optimizer.load_state(parts(tensors, "adam"))
            self.num_rays = int(meta["rays"])
            for i, name in enumerate(_GRIDS):
                self.occupancy.densities[i][:] = tensors[f"density.{name}"]
                self.occupancy.grids[i][:] = tensors[f"grid.{name}"]
        except (*MISFITS, ShapeError) as error:
            expected = f"a training that {self.name} {self.version} can go on with"
            raise misfit(folder, expected, error) from error

    def size(self) -> MethodSize:
        """Count the numbers of the field, and all that are stored."""
        count, unit = self._primitives()
        return MethodSize(count, sum(t.numel() for t in self.stored().values()), unit)

    def _primitives(self) -> tuple[int, str]:
        params = self.network.params
        if "table" in params:
            return len(params["table"]), "grid rows"
        return sum(p.numel() for p in params.values()), "weights"
