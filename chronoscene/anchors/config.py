"""Options that all methods with anchors share. Moments of the training are shares of its length.

Defaults are those of the official ChronoGS code, whose numbers are mostly those of Scaffold-GS.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, Literal, Self

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from chronoscene.errors import ConfigError
from chronoscene.training.config import SplattingConfig

Head = Literal["opacity", "covariance", "color"]
HEADS: tuple[Head, ...] = ("opacity", "covariance", "color")  # The three MLPs
Share = Annotated[float, Field(ge=0, le=1)]
"""A moment as a share of the training: steps would be out of bounds."""
_MAX_OFFSETS = 31  # Their use is stored in the bits of an int32


@dataclass(frozen=True)
class AnchorConfig(SplattingConfig):
    """Shared options. ``(a, b)`` is a learning rate that falls log-linearly from a to b."""

    iterations: PositiveInt = 40_000
    """Training steps; one image each."""

    # Anchors
    offsets_per_anchor: PositiveInt = 10
    """Gaussians per anchor (K, also k)."""
    voxel_size: NonNegativeFloat = 0.001
    """Edge of the cells in which anchors start, in `voxel_unit`; 0 takes the size from the
    cloud."""
    voxel_unit: Literal["world", "training", "spacing"] = "world"
    """``world``: scene units (official code); ``training``: units of the normalised frame;
    ``spacing``: multiples of the median distance of neighbouring sparse points."""
    voxel_origin: Literal["zero", "box"] = "zero"
    """``zero``: cells centred on multiples of the size (code); ``box``: counted from the lower
    corner of the bounding box (paper)."""
    max_initial_anchors: NonNegativeInt = 0
    """Coarsen the voxel until there are at most so many anchors; 0: no limit."""
    max_anchors: NonNegativeInt = 0
    """Growth stops at so many anchors; 0: no limit."""
    base_dim: NonNegativeInt = 16
    """Length of the feature that all periods share (d_b)."""
    hidden_dim: NonNegativeInt = 0
    """Hidden units per MLP; 0: the length of the feature of an anchor in one period (code)."""
    feature_init: Literal["zero", "uniform", "gaussian"] = "zero"
    """``zero`` | ``uniform`` | ``gaussian``: start of the anchor features."""
    feature_init_scale: float = 0.1
    """Half width of the uniform, or standard deviation of the Gaussian start."""

    # Forward pass
    direction: Literal["unit", "full"] = "unit"
    """``unit``: viewing direction of length one (code); ``full``: anchor minus camera centre
    (paper)."""
    visibility: Literal["radius", "frustum"] = "radius"
    """Anchors decoded per view. ``radius``: projected footprint touches the image (code);
    ``frustum``: centre inside the image (paper)."""

    # Loss
    scale_weight: float = 0.01
    """Weight of the mean product of the three scales, a volume in `length_unit` (code; 0 in the
    paper)."""

    # Learning rates
    offset_lr: tuple[float, float] = (0.01, 0.0001)
    """Learning rate of the offsets, multiplied by the extent of the cameras in `length_unit`."""
    feature_lr: tuple[float, float] = (0.0075, 0.0075)
    """Learning rate of the features of anchors."""
    scaling_lr: tuple[float, float] = (0.007, 0.007)
    """Learning rate of the logarithms of the scales of anchors."""
    opacity_lr: tuple[float, float] = (0.002, 0.00002)
    """Learning rate of the MLP that gives opacities."""
    covariance_lr: tuple[float, float] = (0.004, 0.004)
    """Learning rate of the MLP that gives scales and rotations."""
    color_lr: tuple[float, float] = (0.008, 0.00005)
    """Learning rate of the MLP that gives colours."""

    # Growth and pruning
    statistics_from: Share = 500 / 40_000
    """Share of the training after which statistics of the views are collected."""
    density_from: Share = 1_500 / 40_000
    """Share after which anchors grow and are pruned."""
    density_until: Share = 0.5
    """Share at which the set of anchors is final."""
    density_interval: PositiveInt = 100
    """Steps from one round to the next."""
    first_round: Literal["after", "at"] = "after"
    """``after``: the first round is the first multiple of the interval after `density_from`
    (code: 1600); ``at``: the multiple at `density_from` counts too (paper: 1500)."""
    grad_threshold: float = 0.0002
    """Mean gradient of a 2-D centre, in half image sizes, that makes a Gaussian a candidate
    (tau_g)."""
    success_threshold: float = 0.8
    """Share of the interval in which an anchor must be visible to be judged."""
    min_opacity: float = 0.005
    """Anchors whose summed opacity per visit is below this are pruned."""
    prune_by: Literal["opacity", "gradient", "both"] = "opacity"
    """``opacity`` (code); ``gradient`` (main text of the paper); ``both``."""
    prune_gradient: float = 1e-6
    """Summed gradient per visit below which ``gradient`` prunes; the paper gives no value."""
    unused_share: Annotated[float, Field(ge=0, lt=1)] = 0.0
    """Share of the light of any period that may be lost when, once growth is over, the anchors that
    add least to the training views are dropped, and single offsets likewise. 0: none. Not in the
    papers."""
    growth_levels: Annotated[int, Field(ge=0, le=1_024)] = 3
    """Cell sizes that are tried, coarse to fine; each doubles the threshold of the gradients."""
    coarsest_cell: PositiveInt = 16
    """Edge of the coarsest growth cell in voxels."""
    cell_refinement: PositiveInt = 4
    """Ratio of the edges of successive growth cells."""
    chained_levels: bool = True
    """Finer levels are skipped in a round in which the coarser ones added nothing (code)."""
    random_growth: bool = True
    """Candidates are dropped at random: half of them at the coarsest level, fewer at finer ones
    (code)."""
    max_log_scale: float = 0.05
    """Upper bound of the logarithm of the Gaussians' scale in `length_unit`, applied at each round
    (code)."""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.unused_share and self.offsets_per_anchor > _MAX_OFFSETS:
            raise ConfigError(
                "offsets_per_anchor",
                expected=f"at most {_MAX_OFFSETS} with unused_share",
                found=str(self.offsets_per_anchor),
                todo="take fewer offsets, or unused_share=0",
            )

    def in_training_frame(self, training_from_world: float) -> Self:
        """Convert as for every method, and bound and volume of scales and the rate of offsets.

        Offsets that are multiples of an anchor's scale have no unit, but the official code
        multiplies their learning rate by the extent of the cameras, which has one.
        """
        config = super().in_training_frame(training_from_world)
        if self.length_unit == "training":
            return config
        factor = 1 / training_from_world
        return replace(
            config,
            max_log_scale=self.max_log_scale + math.log(training_from_world),
            scale_weight=self.scale_weight / training_from_world**3,
            offset_lr=(self.offset_lr[0] * factor, self.offset_lr[1] * factor),
        )
