"""Options that all methods with explicit Gaussians share.

Defaults are those of the 2023 release of 3D Gaussian Splatting (Kerbl et al.).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveFloat, PositiveInt

from chronoscene.errors import ConfigError
from chronoscene.training.config import SplattingConfig


@dataclass(frozen=True)
class GaussianConfig(SplattingConfig):
    """Shared options. A *moment* is an iteration of the schedule; see `stretch`."""

    iterations: PositiveInt = 30_000
    """Training steps; one image each."""
    stretch: bool = False
    """False: moment i is step i of the training of a model, or of a stage of it, as published:
    however long the training, the schedule stays as it is. True: the whole schedule is stretched
    or squeezed to the length of the training."""
    schedule_length: PositiveInt = 30_000
    """Moments that the schedule was made for; the learning rate of the positions falls over
    them."""

    # Colour
    sh_degree: Annotated[int, Field(ge=0, le=3)] = 3
    """Highest degree of the spherical harmonics, 0 to 3."""
    sh_interval: PositiveInt = 1_000
    """Moments from one degree to the next."""

    # Learning rates of Adam
    position_lr_initial: NonNegativeFloat = 1.6e-4
    """Initial learning rate of positions, times the extent of the cameras."""
    position_lr_final: NonNegativeFloat = 1.6e-6
    """Final learning rate of positions, reached log-linearly at the end of the schedule."""
    sh_dc_lr: NonNegativeFloat = 0.0025
    """Learning rate of the constant coefficients."""
    sh_rest_lr: NonNegativeFloat = 0.000125
    """Learning rate of the other coefficients."""
    opacity_lr: NonNegativeFloat = 0.05
    """Learning rate of the logit of the opacity. Late 2024 releases have 0.025."""
    scale_lr: NonNegativeFloat = 0.005
    """Learning rate of the logarithm of the scale."""
    rotation_lr: NonNegativeFloat = 0.001
    """Learning rate of the quaternion."""

    # Densification
    densification: Literal["adaptive", "mcmc"] = "adaptive"
    """``adaptive``: Gaussians with large gradients are cloned and split, faint ones pruned, and
    opacities reset, as published. ``mcmc``: faint ones move to where others are, the set grows by
    `mcmc_growth` in each round until it has `max_gaussians`, which must be given, and all
    positions move at random: `chronoscene.gaussians.mcmc`. Its authors train so with
    ``densify_until=25000``, ``initial_opacity=0.5`` and ``initial_scale=0.1``."""
    initial_opacity: Annotated[float, Field(gt=0, lt=1)] = 0.1
    """Opacity of each Gaussian at the start."""
    initial_scale: PositiveFloat = 1.0
    """Scale of each Gaussian at the start, times the distance of the points around it."""
    densify_from: NonNegativeInt = 500
    """Moment after which Gaussians are added and pruned."""
    densify_until: NonNegativeInt = 15_000
    """Moment from which the set of Gaussians is final."""
    densify_interval: PositiveInt = 100
    """Steps, not moments, from one round to the next: a round needs views, not time."""
    gradient_threshold: NonNegativeFloat = 0.0002
    """Mean norm of the gradient of the projected centre, in half image sizes (tau_pos)."""
    clone_scale: NonNegativeFloat = 0.01
    """Gaussians up to this scale, times the extent of the cameras, are copied; others split."""
    split_factor: Annotated[float, Field(ge=1)] = 1.6
    """Each of the two halves is smaller by this (phi)."""
    min_opacity: NonNegativeFloat = 0.005
    """Gaussians below it are pruned (epsilon_alpha)."""
    max_scale: NonNegativeFloat = 0.1
    """Gaussians above this scale, times the extent of the cameras, are pruned."""
    prune_large_from: NonNegativeInt = 3_000
    """Moment after which `max_scale` counts."""
    reset_interval: PositiveInt = 3_000
    """Moments from one opacity reset to the next, while the set of Gaussians grows."""
    reset_opacity: Annotated[float, Field(gt=0, lt=1)] = 0.01
    """No opacity is above it after a reset."""
    max_gaussians: NonNegativeInt = 0
    """No round grows the set beyond this; the largest gradients come first. 0: no limit."""
    grow_below: NonNegativeInt = 0
    """Rounds grow only sets that are smaller than this. 0: all."""
    prune_above: NonNegativeInt = 0
    """Rounds prune only sets that are larger than this."""

    # Densification of kind mcmc
    mcmc_growth: NonNegativeFloat = 0.05
    """Share of the set that a round adds."""
    mcmc_noise: NonNegativeFloat = 5e5
    """Strength of the random moves of positions, times their learning rate; one over
    `length_unit` squared."""
    mcmc_opacity_weight: NonNegativeFloat = 0.01
    """Weight of the mean opacity in the loss."""
    mcmc_scale_weight: NonNegativeFloat = 0.01
    """Weight of the mean scale, in `length_unit`, in the loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.densification == "mcmc" and not self.max_gaussians:
            raise ConfigError(
                "max_gaussians",
                expected="the number of Gaussians to grow to, as densification is mcmc",
                found="0",
                todo="give it, such as max_gaussians=100000",
            )

    def in_training_frame(self, training_from_world: float) -> Self:
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        # A random move is a variance times a learning rate: a length to the third power.
        return replace(
            config,
            mcmc_noise=self.mcmc_noise / training_from_world**2,
            mcmc_scale_weight=self.mcmc_scale_weight / training_from_world,
        )
