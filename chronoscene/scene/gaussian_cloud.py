"""Gaussians as arrays: what a file of 3DGS holds."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.similarity import Sim3

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class GaussianCloud:
    """Gaussians that do not change over time, in any frame."""

    means: Floats
    """Centres. [N, 3]"""
    quats: Floats
    """Rotations wxyz, of any length but 0. [N, 4]"""
    scales: Floats
    """Standard deviations. [N, 3]"""
    opacities: Floats
    """0..1. [N]"""
    sh_coeffs: Floats
    """Spherical harmonics up to degree 3; the colour is 1/2 where all are 0. [N, 16, 3]"""

    def __len__(self) -> int:
        return len(self.means)

    def transformed(self, target_from_source: Sim3) -> GaussianCloud:
        """The same in another frame, whose axes are parallel: colours depend on directions."""
        assert np.allclose(target_from_source.rotation, np.eye(3))
        means = target_from_source.apply(self.means.astype(np.float64)).astype(np.float32)
        return replace(self, means=means, scales=self.scales * np.float32(target_from_source.scale))
