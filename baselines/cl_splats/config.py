"""Options of CL-Splats."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from pydantic import Field, NonNegativeFloat, NonNegativeInt, PositiveInt

from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class CLSplatsConfig(GaussianConfig):
    """Options beside those of all methods with Gaussians. Widths are shares of that of the image.

    Defaults are the configuration of the released code where it has the option.
    """

    sh_degree: Annotated[int, Field(ge=0, le=3)] = 0
    """Highest degree of the spherical harmonics, 0 to 3."""
    opacity_lr: NonNegativeFloat = 0.025
    """Learning rate of the logit of the opacity."""
    densification: Literal["adaptive"] = "adaptive"
    """The other kind moves Gaussians to anywhere."""

    # Change detection
    change_threshold: NonNegativeFloat = 0.3
    """Score from which on a pixel has changed."""
    dilation: NonNegativeFloat = 0.012
    """Radius by which masks grow at last."""

    # Which Gaussians are optimised
    vote_share: Annotated[float, Field(ge=0, le=1)] = 0.5
    """Gaussians are, if in more than this share of the views that see them they have changed."""
    samples: NonNegativeInt = 2_000
    """Points drawn in front of what the model before shows in changed pixels; new Gaussians start
    at those that the votes of the views leave, and at new sparse points."""

    # Where they may be
    sphere_link: NonNegativeFloat = 0.1
    """Gaussians nearer than this, times their extent, are in one sphere."""
    sphere_share: Annotated[float, Field(ge=0, le=1)] = 0.95
    """Share of the Gaussians of a sphere that lie within its radius."""
    sphere_margin: NonNegativeFloat = 0.02
    """Outside of a sphere, times the extent of the cameras, that is still inside."""
    stray_checks: NonNegativeInt = 3
    """Gaussians found outside of all spheres so often, one time after the other, are pruned."""
    stray_interval: PositiveInt = 50
    """Steps from one check to the next."""
