"""Differentiable rendering of 3-D Gaussians: one function, several backends.

Gaussians and cameras go in, a `Rasterization` comes out. Equations, constants and tolerances are in
README.md beside this file.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING

from chronoscene.checks import check_choice
from chronoscene.errors import BackendError
from chronoscene.rasterizer.constants import EPS2D, FAR_PLANE, NEAR_PLANE

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["BACKENDS", "FAR_PLANE", "NEAR_PLANE", "RasterInfo", "Rasterization", "rasterize"]

BACKENDS = {
    "reference": "chronoscene.rasterizer.reference",
    "cpu": "chronoscene.rasterizer.cpu",
    "cuda": "chronoscene.rasterizer.gsplat_backend",
}
"""Module of each backend by name; imported when first used. Its function ``rasterize`` takes
`inputs.Inputs` that were checked."""


@dataclass(slots=True, eq=False)
class RasterInfo:
    """Per-Gaussian facts of one call. Camera index first."""

    means2d: Tensor
    """Projected centres in pixels. After ``backward()`` its ``grad`` is d loss / d means2d in
    pixels: the densification signal of 3DGS. Zero rows for culled Gaussians. If absolute gradients
    were asked for, its attribute ``absgrad`` is then the sum over the pixels of the absolute value
    of what each adds to ``grad``, as in gsplat. [C, N, 2]"""
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


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float = NEAR_PLANE,
    far_plane: float = FAR_PLANE,
    eps2d: float = EPS2D,
    backgrounds: Tensor | None = None,
    render_depth: bool = False,
    absgrad: bool = False,
    antialiased: bool = False,
    backend: str = "auto",
    check_finite: bool = True,
) -> Rasterization:
    """Render Gaussians into images.

    Differentiable in means, quats, scales, opacities, colors and backgrounds. A Gaussian outside
    the depth range or the image, with an opacity below 1/255 (negative ones too), with a
    quaternion of length zero, or with any number that is not finite is culled: it changes nothing
    and its gradients are zero. The limits are in `constants`.

    Convention:
        World to camera, +z forward; pixel (0, 0) is centred at (0.5, 0.5).

    Args:
        means: Centres in world units. [N, 3]
        quats: Rotations wxyz, of any length but 0. [N, 4]
        scales: Standard deviations along the rotated axes in world units. [N, 3]
        opacities: Peak opacity, 0..1. [N]
        colors: Any number of channels. [N, D]
        viewmats: World-to-camera transforms. [C, 4, 4]
        Ks: Intrinsics in pixels. [C, 3, 3]
        width: Image width in pixels.
        height: Image height in pixels.
        near_plane: Centres nearer than this z-depth, in world units, are culled.
        far_plane: Centres farther than this z-depth, in world units, are culled.
        eps2d: Variance in pixels squared, 0 or more, added to the projected covariances.
        backgrounds: What the remaining light sees; None is black. [C, D]
        render_depth: Also return the expected z-depth, differentiable.
        absgrad: Also sum absolute gradients, see `RasterInfo.means2d`; for three channels without
            depth.
        antialiased: Lower the opacity of small Gaussians, so that the blur does not add light.
        backend: auto, reference, cpu or cuda. Auto is cuda for CUDA tensors, else cpu.
        check_finite: Raise on nan or infinite numbers, and on invalid cameras. Without this check,
            Gaussians with such numbers are culled.

    Raises:
        ShapeError: If a shape differs from the above, a number is not finite, or an option or a
            camera is outside the limits of `constants`.
        BackendError: If the backend is unknown or cannot be used on this machine.
    """
    from chronoscene.rasterizer.inputs import Inputs, check_inputs

    check_choice("backend", backend, ["auto", *BACKENDS], error=BackendError)
    if backend == "auto":
        backend = "cuda" if means.is_cuda else "cpu"
    inputs = Inputs(
        means,
        quats,
        scales,
        opacities,
        colors,
        viewmats,
        Ks,
        width=width,
        height=height,
        near_plane=near_plane,
        far_plane=far_plane,
        eps2d=eps2d,
        backgrounds=backgrounds,
        render_depth=render_depth,
        absgrad=absgrad,
        antialiased=antialiased,
    )
    check_inputs(inputs, check_finite)
    result: Rasterization = import_module(BACKENDS[backend]).rasterize(inputs)
    return result
