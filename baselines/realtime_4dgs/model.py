"""Gaussians in space and time, where they start, and how they are split."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.realtime_4dgs.config import Realtime4DGSConfig
from baselines.realtime_4dgs.slicing import ORDERS, SHAPES, slice_at, turned
from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.model import GaussianModel
from chronoscene.training.devices import exp, normal

_STREAM = 6  # Keeps the time centres apart from other draws of the same seed


@dataclass(eq=False)
class SpacetimeModel(GaussianModel):
    """Groups of `SHAPES` in `parameters`."""

    _: KW_ONLY
    periods: int
    """Number of periods of the first training, which lie from time 0 to 1."""
    cycle: float
    """Length of the longest wave of the colours."""
    order: int = ORDERS
    """Order of the shortest wave in use; those not yet in use are zero."""

    def at_period(self, period: float) -> Mapping[str, Tensor]:
        """The Gaussians in space that are there at the time."""
        time = period / max(self.periods - 1, 1)
        return slice_at(self.parameters, time, cycle=self.cycle, order=self.order)


def start_in_time(
    parameters: dict[str, Tensor],
    point_periods: NDArray[np.bool_],
    config: Realtime4DGSConfig,
    seed: int,
) -> dict[str, Tensor]:
    """Gaussians in space, and what they have besides.

    Args:
        parameters: Of the Gaussians in space, of one device.
        point_periods: Which period sees the sparse point of each. [N, T]
        config: Says how they start in time.
        seed: Of the time centres that are drawn.
    """
    count, periods = point_periods.shape
    centres = np.random.default_rng((seed, _STREAM)).uniform(-0.1, 1.1, (count,))
    if config.start_times == "seen":
        seen = point_periods.sum(1)
        times = point_periods @ np.linspace(0.0, 1.0, periods)
        centres = np.where(seen > 0, times / np.maximum(seen, 1), centres)
    means = parameters["means"]
    made = {name: means.new_zeros(count, *shape) for name, shape in SHAPES.items()}
    made["right_quats"][:, 0] = 1.0
    made["time_means"] = torch.from_numpy(centres.astype(np.float32)).to(means.device)
    made["log_time_scales"].fill_(float(np.log(config.initial_time_scale)))
    return made | parameters


def scatter_in_spacetime(
    parts: dict[str, Tensor], config: GaussianConfig, generator: np.random.Generator
) -> None:
    """Centres are samples of the Gaussians in (x, y, z, t); all four scales are divided."""
    scales = torch.cat([parts["log_scales"], parts["log_time_scales"][:, None]], dim=-1)
    scales = exp(scales.double())
    samples = scales * normal(generator, tuple(scales.shape), scales)
    moves = turned(parts["quats"].double(), parts["right_quats"].double(), samples).float()
    parts["means"] += moves[:, :3]
    parts["time_means"] += moves[:, 3]
    for name in ("log_scales", "log_time_scales"):
        parts[name] -= float(np.log(config.split_factor))
