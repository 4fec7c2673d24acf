"""PLY as 3DGS writes it, which most programs for Gaussians read: 248 bytes per Gaussian.

In float32: the centre; a normal, which is 0 and unused; the constant coefficient of each colour;
the other 15 of red, then those of green and of blue; the logit of the opacity; the natural
logarithms of the scales; the rotation wxyz.
"""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from plyfile import PlyData, PlyElement

from chronoscene.scene.gaussian_cloud import GaussianCloud

NAMES = (
    *("x", "y", "z", "nx", "ny", "nz"),
    *(f"f_dc_{i}" for i in range(3)),
    *(f"f_rest_{i}" for i in range(45)),
    "opacity",
    *(f"scale_{i}" for i in range(3)),
    *(f"rot_{i}" for i in range(4)),
)

_END = b"\nend_header\n"
_LIMIT = 1e-6
"""Opacities are kept this far from 0 and 1, which have no logit."""


def encode(cloud: GaussianCloud) -> bytes:
    """Make a binary file."""
    count = len(cloud)
    opacities = cloud.opacities.astype(np.float64).clip(_LIMIT, 1 - _LIMIT)
    columns = (
        cloud.means,
        np.zeros((count, 3)),
        cloud.sh_coeffs[:, 0],
        cloud.sh_coeffs[:, 1:].transpose(0, 2, 1).reshape(count, 45),
        np.log(opacities / (1 - opacities))[:, None],
        np.log(cloud.scales),
        cloud.quats,
    )
    table = np.concatenate(columns, axis=1, dtype="<f4", casting="same_kind")
    vertices = table.view([(name, "<f4") for name in NAMES])[:, 0]
    element = PlyElement.describe(vertices, "vertex")
    file = io.BytesIO()
    PlyData([element], byte_order="<").write(file)
    return file.getvalue()


def with_comments(data: bytes, comments: Sequence[str]) -> bytes:
    """Put lines into the header of a file."""
    form, end, rest = data.partition(b" 1.0\n")
    return form + end + "".join(f"comment {line}\n" for line in comments).encode("ascii") + rest


def decode(data: bytes) -> GaussianCloud:
    """Read what `encode` made."""
    # plyfile reads what is not a file on the disk number by number.
    begin = data.index(_END) + len(_END)
    table = np.frombuffer(data, "<f4", offset=begin).reshape(-1, len(NAMES))

    def columns(start: int, stop: int) -> NDArray[np.float32]:
        return np.ascontiguousarray(table[:, start:stop], np.float32)

    rest = columns(9, 54).reshape(-1, 3, 15).transpose(0, 2, 1)
    return GaussianCloud(
        means=columns(0, 3),
        quats=columns(58, 62),
        scales=np.exp(columns(55, 58)),
        opacities=(1 / (1 + np.exp(-columns(54, 55)[:, 0]))).astype(np.float32),
        sh_coeffs=np.concatenate([columns(6, 9)[:, None], rest], axis=1),
    )
