"""What a rasterizer backend takes and returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from torch import Tensor


@dataclass(slots=True, eq=False)
class RasterInfo:
    """Per-Gaussian facts of one call. Camera index first."""

    means2d: Tensor
    """Projected centres in pixels. After ``backward()`` its ``grad`` is d loss / d means2d in
    pixels: the densification signal of 3DGS. Zero rows for culled Gaussians. [C, N, 2]"""
    radii: Tensor
    """Half extent of the footprint in pixels, per axis; 0 where culled. int32 [C, N, 2]"""
    depths: Tensor
    """z-depth of the centres. Not differentiable. [C, N]"""


@dataclass(slots=True, eq=False)
class Rasterization:
    """Images of one call."""

    image: Tensor
    """Composited colours over the background. [C, H, W, D]"""
    alphas: Tensor
    """Accumulated opacity. [C, H, W, 1]"""
    depths: Tensor | None
    """Expected z-depth: sum of weight times depth over accumulated opacity, 0 where that is 0;
    None unless asked for. [C, H, W, 1]"""
    info: RasterInfo
