"""Options of 3D Gaussian Splatting."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.gaussians.config import GaussianConfig


@dataclass(frozen=True)
class GaussianSplattingConfig(GaussianConfig):
    """Shared options alone, whose defaults are those of the 2023 release."""
