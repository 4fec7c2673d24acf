"""Gaussians with a deformation field, and where the field starts."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, replace
from math import sqrt
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.deformation_4dgs.field import Corner, Field, deform
from baselines.deformation_4dgs.field.function import time_cell
from chronoscene.gaussians.model import GaussianModel

_SPACE_START = (0.1, 0.5)  # Numbers in planes without time, at first
_STREAM = 2  # Keeps the field apart from other draws of the same seed


@dataclass(eq=False)
class DeformedModel(GaussianModel):
    """Canonical Gaussians in `parameters`, the tensors of a field in `shared`."""

    _: KW_ONLY
    field: Field
    times: tuple[float, ...]
    """Place of each period on the time axis of the planes, 0..1."""
    is_deforming: bool = False
    """False in the first stage, which leaves the field alone."""

    def at_period(self, period: float) -> Mapping[str, Tensor]:
        """Gaussians deformed by the field; between periods at a time between theirs."""
        if not self.is_deforming:
            return self.parameters
        time = float(np.interp(period, range(len(self.times)), self.times))
        return self.parameters | deform(self.parameters, self.shared, self.field, time)

    def with_new_period(self) -> Self:
        """Return the model with a row for one more period at the end of the planes with time.

        The row holds what the planes hold at the last period; earlier ones keep their rows.
        """
        cell, share = time_cell(self.field, self.times[-1])
        shared = {name: tensor.detach() for name, tensor in self.shared.items()}
        for name, plane in shared.items():
            if name.startswith("planes.") and name.endswith("t"):
                row = torch.lerp(plane[cell], plane[cell + 1], share)
                shared[name] = torch.cat([plane, row[None]])
        rows = self.field.time_cells
        times = (*(time * (rows - 1) / rows for time in self.times), 1.0)
        return replace(
            self, shared=shared, field=replace(self.field, time_cells=rows + 1), times=times
        )


def find_box(points: NDArray[np.floating], quantile: float) -> tuple[Corner, Corner]:
    """Low and high corner of a box that leaves out this share of points at each side. [P, 3]"""
    low, high = np.quantile(points, (quantile, 1 - quantile), axis=0).astype(np.float32)
    return tuple(low.tolist()), tuple(high.tolist())


def start_field(field: Field, seed: int, *, zero_outputs: bool) -> dict[str, Tensor]:
    """Tensors of a field before training, float32 on the CPU.

    Planes with time are ones, the others uniform 0.1..0.5; weights uniform after Glorot and Bengio,
    biases uniform up to 1 / sqrt(inputs).

    Args:
        seed: Seed of all draws.
        zero_outputs: True for output layers of zeros, so that nothing is deformed.
    """
    generator = np.random.default_rng((seed, _STREAM))

    def uniform(low: float, high: float, shape: tuple[int, ...]) -> Tensor:
        return torch.from_numpy(generator.uniform(low, high, shape).astype(np.float32))

    tensors = {}
    shapes = field.shapes()
    for name, shape in shapes.items():
        if name.startswith("planes."):
            ones = name.endswith("t")
            tensors[name] = torch.ones(shape) if ones else uniform(*_SPACE_START, shape)
        elif zero_outputs and ".output." in name:
            tensors[name] = torch.zeros(shape)
        else:
            inputs = shapes[name.replace(".bias", ".weight")][1]
            bound = sqrt(6 / sum(shape)) if name.endswith(".weight") else 1 / sqrt(inputs)
            tensors[name] = uniform(-bound, bound, shape)
    return tensors
