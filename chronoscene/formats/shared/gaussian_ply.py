"""Gaussians in the PLY file of 3DGS, which most programs for them read."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from plyfile import PlyData, PlyElement

from chronoscene.io.staging import replacing
from chronoscene.scene.gaussian_cloud import GaussianCloud

NAMES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)

_LIMIT = 1e-6
"""Opacities are kept this far from 0 and 1, which have no logit."""


def write_gaussians(path: Path, gaussians: GaussianCloud) -> None:
    """Write a binary file; it appears complete or not at all.

    It has, in float32, the centre; a normal, which is 0 and unused; the constant coefficient of
    each colour; the other 15 of red, then those of green and of blue; the logit of the opacity; the
    natural logarithms of the scales; the rotation wxyz.

    Raises:
        DiskFullError: If there is no space for it.
    """
    count = len(gaussians)
    opacities = gaussians.opacities.astype(np.float64).clip(_LIMIT, 1 - _LIMIT)
    columns = (
        gaussians.means,
        np.zeros((count, 3)),
        gaussians.sh_coeffs[:, 0],
        gaussians.sh_coeffs[:, 1:].transpose(0, 2, 1).reshape(count, 45),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(gaussians.scales),
        gaussians.quats,
    )
    table = np.concatenate(columns, axis=1, dtype="<f4", casting="same_kind")
    vertices = table.view([(name, "<f4") for name in NAMES])[:, 0]
    with replacing(path) as partial:
        PlyData([PlyElement.describe(vertices, "vertex")], byte_order="<").write(partial)
