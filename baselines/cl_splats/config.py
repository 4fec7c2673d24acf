"""Options of CL-Splats."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from chronoscene.checks import check_choice
from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class CLSplatsConfig(GaussianConfig):
    """Options beside those of all methods with Gaussians. Widths are shares of that of the image.

    Defaults are the configuration of the released code where it has the option.
    """

    sh_degree: int = 0
    """Highest degree of the spherical harmonics, 0 to 3."""
    opacity_lr: float = 0.025
    """Learning rate of the logit of the opacity."""

    # Change detection
    patch: float = 0.006
    """Standard deviation of the windows in which render and photo are compared; those of a second
    scale are twice as wide."""
    structure_weight: float = 0.3
    """Weight of 1 - structural similarity; chromaticity has weight 1."""
    brightness_weight: float = 0.0
    """Weight of the difference in brightness. 0: shadows are no changes."""
    change_threshold: float = 0.3
    """Score from which on a pixel has changed."""
    cleaning: float = 0.006
    """Radius of the opening and the closing of masks."""
    min_area: float = 0.0005
    """Smaller spots are dropped; share of the area of the image."""
    dilation: float = 0.012
    """Radius by which masks grow at last."""

    # Which Gaussians are optimised
    vote_share: float = 0.5
    """Gaussians are, if in more than this share of the views that see them they have changed."""
    samples: int = 2_000
    """Points drawn in front of what the model before shows in changed pixels; new Gaussians start
    at those that the votes of the views leave, and at new sparse points."""

    # Where they may be
    sphere_link: float = 0.1
    """Gaussians nearer than this, times their extent, are in one sphere."""
    sphere_share: float = 0.95
    """Share of the Gaussians of a sphere that lie within its radius."""
    sphere_margin: float = 0.02
    """Outside of a sphere, times the extent of the cameras, that is still inside."""
    stray_checks: int = 3
    """Gaussians found outside of all spheres so often, one time after the other, are pruned."""
    stray_interval: int = 50
    """Steps from one check to the next."""

    minima: ClassVar[Mapping[str, int]] = {**GaussianConfig.minima, "stray_interval": 1}

    def __post_init__(self) -> None:
        super().__post_init__()
        # The other kind moves Gaussians to anywhere.
        check_choice("densification", self.densification, ("adaptive",))
