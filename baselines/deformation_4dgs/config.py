"""Options of 4DGS."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar, Self

from chronoscene.errors import ConfigError
from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class Deformation4DGSConfig(GaussianConfig):
    """Defaults are those of the released configuration for scenes with several cameras.

    A training has two stages, and moments are counted anew in the second.
    """

    iterations: int = 18_000
    schedule_length: int = 20_000
    ssim_weight: float = 0.0
    densify_until: int = 10_000
    grow_below: int = 360_000
    prune_above: int = 200_000
    coarse_until: int = 3_000
    """Moments of the first stage, which trains static Gaussians on the photos of all periods."""
    white_background: bool = True
    """True for a white background, whatever the benchmark asks for."""

    # Field
    channels: int = 16
    """Channels of the planes."""
    plane_size: int = 64
    """Cells along each spatial axis of the first level; twice as many on each next."""
    levels: int = 2
    """Resolutions of the planes along the spatial axes."""
    time_cells: int = 150
    """Cells along the time axis, 2 or more. 0: as many as there are periods, but at least 3."""
    width: int = 128
    """Hidden units of the trunk, and of each head."""
    deform_opacity: bool = True
    """True if the opacity may change from period to period."""
    deform_color: bool = True
    """True if the spherical harmonics may change from period to period."""
    box_quantile: float = 0.0
    """Share of the sparse points that may lie outside the box of the field at each of its sides.
    0: it holds all of them, however far a wrong one is."""
    half_time_axis: bool = True
    """True to read times 0 to 1 from the second half of the planes' time axis only."""
    zero_start: bool = False
    """True to start the heads at zero, so that the second stage begins where the first ended."""
    offset_unit: float = 1.0
    """Factor of the output of the position head, in `length_unit`."""

    # Learning rates, times the extent of the cameras in `length_unit`
    field_lr_initial: float = 1.6e-4
    """Initial learning rate of the trunk and the heads."""
    field_lr_final: float = 1.6e-5
    """Final learning rate of the trunk and the heads, reached log-linearly."""
    plane_lr_initial: float = 1.6e-3
    """Initial learning rate of the planes."""
    plane_lr_final: float = 1.6e-4
    """Final learning rate of the planes, reached log-linearly."""

    # Weights of terms of the loss
    space_smoothness: float = 2e-4
    """Squared second differences of the planes without time."""
    time_smoothness: float = 1e-3
    """Squared second differences of the planes with time, along the time axis."""
    time_sparsity: float = 1e-4
    """Distance of the planes with time from one, where time changes nothing."""

    minima: ClassVar[Mapping[str, int]] = {
        **GaussianConfig.minima,
        "channels": 1,
        "plane_size": 2,
        "levels": 1,
        "width": 1,
    }

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.time_cells == 1:
            raise ConfigError(
                "time_cells", expected="0, or 2 and more", found="1", todo="correct the value"
            )
        if self.box_quantile >= 0.5:
            raise ConfigError(
                "box_quantile",
                expected="less than 0.5",
                found=str(self.box_quantile),
                todo="give a small share, such as 0.01",
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
