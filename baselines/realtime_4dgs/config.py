"""Options of realtime4DGS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal, Self

from pydantic import NonNegativeFloat, PositiveFloat, PositiveInt

from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class Realtime4DGSConfig(GaussianConfig):
    """Defaults are those of the released configuration for scenes with several cameras.

    Times are in units of the time from the first period to the last.
    """

    densification: Literal["adaptive"] = "adaptive"
    """The other kind moves and shrinks Gaussians in space alone."""
    start_times: Literal["uniform", "seen"] = "uniform"
    """Time centres at the start. ``uniform``: anywhere from 0.1 before the first period to 0.1
    after the last. ``seen``: the mean of the periods whose photos see the sparse point."""
    initial_time_scale: PositiveFloat = 0.2**0.5
    """Standard deviations in time at the start."""
    wave_cycle: PositiveFloat = 1.0
    """Length of the longest wave of the colours in time. 1: each Gaussian has the same colour in
    the first period and in the last, as in the released code."""
    wave_interval: PositiveInt = 1_000
    """Moments from one order of the waves to the next; they begin after the spherical harmonics."""

    # Learning rates
    time_lr: NonNegativeFloat = 1.6e-4
    """Learning rate of the time centres, times the extent of the cameras in `length_unit`."""
    wave_dc_lr: NonNegativeFloat = 0.000125
    """Learning rate of the waves of the constant coefficients."""

    def in_training_frame(self, training_from_world: float) -> Self:
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        # The extent is that of the training frame from now on.
        return replace(config, time_lr=self.time_lr / training_from_world)
