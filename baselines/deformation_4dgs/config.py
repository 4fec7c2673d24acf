"""Options of 4DGS."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from chronoscene.errors import ConfigError
from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class Deformation4DGSConfig(GaussianConfig):
    """Defaults are those of the released configuration for scenes with several cameras.

    A training has two stages, and moments are counted anew in the second.
    """

    iterations: PositiveInt = 18_000
    schedule_length: PositiveInt = 20_000
    ssim_weight: Annotated[float, Field(ge=0, le=1)] = 0.0
    densify_until: NonNegativeInt = 10_000
    grow_below: NonNegativeInt = 360_000
    prune_above: NonNegativeInt = 200_000
    coarse_until: NonNegativeInt = 3_000
    """Moments of the first stage, which trains static Gaussians on the photos of all periods."""
    white_background: bool = True
    """True for a white background, whatever the benchmark asks for."""

    # Field
    channels: PositiveInt = 16
    """Channels of the planes."""
    plane_size: Annotated[int, Field(ge=2)] = 64
    """Cells along each spatial axis of the first level; twice as many on each next."""
    levels: PositiveInt = 2
    """Resolutions of the planes along the spatial axes."""
    time_cells: NonNegativeInt = 150
    """Cells along the time axis, 2 or more. 0: as many as there are periods, but at least 3."""
    width: PositiveInt = 128
    """Hidden units of the trunk, and of each head."""
    deform_opacity: bool = True
    """True if the opacity may change from period to period."""
    deform_color: bool = True
    """True if the spherical harmonics may change from period to period."""
    box_quantile: Annotated[float, Field(ge=0, lt=0.5)] = 0.0
    """Share of the sparse points that may lie outside the box of the field at each of its sides.
    0: it holds all of them, however far a wrong one is."""
    half_time_axis: bool = True
    """True to read times 0 to 1 from the second half of the planes' time axis only."""
    zero_start: bool = False
    """True to start the heads at zero, so that the second stage begins where the first ended."""
    offset_unit: NonNegativeFloat = 1.0
    """Factor of the output of the position head, in `length_unit`."""

    # Learning rates, times the extent of the cameras in `length_unit`
    field_lr_initial: NonNegativeFloat = 1.6e-4
    """Initial learning rate of the trunk and the heads."""
    field_lr_final: NonNegativeFloat = 1.6e-5
    """Final learning rate of the trunk and the heads, reached log-linearly."""
    plane_lr_initial: NonNegativeFloat = 1.6e-3
    """Initial learning rate of the planes."""
    plane_lr_final: NonNegativeFloat = 1.6e-4
    """Final learning rate of the planes, reached log-linearly."""

    # Weights of terms of the loss
    space_smoothness: NonNegativeFloat = 2e-4
    """Squared second differences of the planes without time."""
    time_smoothness: NonNegativeFloat = 1e-3
    """Squared second differences of the planes with time, along the time axis."""
    time_sparsity: NonNegativeFloat = 1e-4
    """Distance of the planes with time from one, where time changes nothing."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.time_cells == 1:
            raise ConfigError(
                "time_cells", expected="0, or 2 and more", found="1", todo="correct the value"
            )

    def in_training_frame(self, training_from_world: float) -> Self:
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        # The extent is that of the training frame from now on.
        return replace(
            config,
            offset_unit=self.offset_unit * training_from_world,
            field_lr_initial=self.field_lr_initial / training_from_world,
            field_lr_final=self.field_lr_final / training_from_world,
            plane_lr_initial=self.plane_lr_initial / training_from_world,
            plane_lr_final=self.plane_lr_final / training_from_world,
        )
