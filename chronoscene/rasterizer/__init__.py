"""Differentiable rendering of 3-D Gaussians: one function, several backends.

Equations, constants and tolerances are in README.md beside this file.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

from chronoscene.checks import check_choice
from chronoscene.errors import BackendError
from chronoscene.rasterizer.constants import EPS2D, FAR_PLANE, NEAR_PLANE
from chronoscene.rasterizer.types import RasterInfo, Rasterization

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["BACKENDS", "FAR_PLANE", "NEAR_PLANE", "RasterInfo", "Rasterization", "rasterize"]

BACKENDS = {
    "reference": "chronoscene.rasterizer.reference",
    "cpu": "chronoscene.rasterizer.cpu",
    "cuda": "chronoscene.rasterizer.gsplat_backend",
}
"""Module of each backend by name; imported when first used."""


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
    backend: str = "auto",
    check_finite: bool = True,
) -> Rasterization:
    """Render Gaussians into images.

    Differentiable in means, quats, scales, opacities, colors and backgrounds. A Gaussian outside
    the depth range or the image, with an opacity below 1/255 (negative ones too), with a
    quaternion of no length, or with any number that is not finite is culled: it changes nothing
    and gets gradient zero. The limits are in `constants`.

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
        backend: auto, reference, cpu or cuda. Auto is cuda for CUDA tensors, else cpu.
        check_finite: Raise on nan or infinite numbers, and on cameras that are none. Off,
            Gaussians with such numbers are culled.

    Raises:
        ShapeError: If a shape differs from the above, a number is not finite, or an option or a
            camera is outside the limits of `constants`.
        BackendError: If the backend is unknown or cannot be used on this machine.
    """
    from chronoscene.rasterizer.input_checks import (
        check_cameras,
        check_finite_inputs,
        check_inputs,
        check_options,
    )

    check_choice("backend", backend, ["auto", *BACKENDS], error=BackendError)
    if backend == "auto":
        backend = "cuda" if means.is_cuda else "cpu"
    gaussians = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
    }
    arrays = {**gaussians, "viewmats": viewmats, "Ks": Ks}
    check_inputs(arrays, backgrounds, width, height)
    check_options(near_plane, far_plane, eps2d)
    if check_finite:
        colored = {} if backgrounds is None else {"backgrounds": backgrounds}
        check_finite_inputs({**arrays, **colored})
        check_cameras(viewmats, Ks, width, height)
    return import_module(BACKENDS[backend]).rasterize(
        *arrays.values(),
        width,
        height,
        near_plane=near_plane,
        far_plane=far_plane,
        eps2d=eps2d,
        backgrounds=backgrounds,
        render_depth=render_depth,
    )
