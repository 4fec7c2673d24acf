"""Gaussians as arrays, as in a file of 3DGS."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.similarity import Sim3

if TYPE_CHECKING:
    from torch import Tensor

Floats = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class GaussianCloud:
    """Gaussians that do not change over time, in any frame.

    These are the activated values that `gsplat.rasterization` takes; lengths are in units of the
    frame.
    """

    means: Floats
    """Centres. [N, 3]"""
    quats: Floats
    """Rotations from the axes of the Gaussian to the frame, wxyz, of any length but 0. [N, 4]"""
    scales: Floats
    """Standard deviations along the axes of the Gaussian. [N, 3]"""
    opacities: Floats
    """0..1. [N]"""
    sh_coeffs: Floats
    """Spherical harmonics up to degree 3 in the axes of the frame, RGB; the colour is 1/2 where all
    are 0. [N, 16, 3]"""

    def __len__(self) -> int:
        return len(self.means)

    def rows(self, which: NDArray[np.bool_] | NDArray[np.intp]) -> GaussianCloud:
        """Return some of the Gaussians, copied, by flags or indices."""
        return GaussianCloud(*(getattr(self, field.name)[which] for field in fields(self)))

    def tensors(self, device: str = "cpu") -> dict[str, Tensor]:
        """Return the arrays by their names as torch tensors in float32."""
        import torch

        return {f.name: torch.tensor(getattr(self, f.name), device=device) for f in fields(self)}

    def transformed(self, target_from_source: Sim3) -> GaussianCloud:
        """Return the Gaussians in another frame with parallel axes, so that colours stay."""
        assert np.allclose(target_from_source.rotation, np.eye(3))
        means = target_from_source.apply(self.means.astype(np.float64)).astype(np.float32)
        return replace(self, means=means, scales=self.scales * np.float32(target_from_source.scale))
