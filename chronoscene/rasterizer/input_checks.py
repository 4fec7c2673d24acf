"""Checks of what goes into the rasterizer: shapes always, finite numbers unless switched off."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.rasterizer.constants import DEPTH_MAX, EXTENT_MAX, FOCAL_MIN, SIZE_MAX


def check_inputs(
    arrays: dict[str, Tensor], backgrounds: Tensor | None, width: int, height: int
) -> None:
    """Raise a ShapeError that names the first argument with a wrong shape.

    Args:
        arrays: The tensor arguments of `chronoscene.rasterizer.rasterize` by name.
        backgrounds: Its argument of that name.
        width: Image width in pixels.
        height: Image height in pixels.
    """
    for name, size in (("width", width), ("height", height)):
        if not 1 <= size <= SIZE_MAX:
            raise ShapeError(
                name,
                expected=f"1 to {SIZE_MAX} pixels",
                found=str(size),
                todo="correct the argument, or render a larger image in parts",
            )
    for name, array in arrays.items():
        if not array.is_floating_point():
            raise ShapeError(
                name, expected="floating point", found=str(array.dtype), todo="call .float()"
            )
    count, cameras = len(arrays["means"]), len(arrays["viewmats"])
    check_shape("means", arrays["means"], (count, 3))
    check_shape("quats", arrays["quats"], (count, 4))
    check_shape("scales", arrays["scales"], (count, 3))
    check_shape("opacities", arrays["opacities"], (count,))
    check_shape("colors", arrays["colors"], (count, None))
    check_shape("viewmats", arrays["viewmats"], (cameras, 4, 4))
    check_shape("Ks", arrays["Ks"], (cameras, 3, 3))
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (cameras, arrays["colors"].shape[1]))


def check_options(near_plane: float, far_plane: float, eps2d: float) -> None:
    """Raise a ShapeError unless 0 < near < far, within limits, and the blur is not negative."""
    if not 1 / DEPTH_MAX <= near_plane < far_plane <= DEPTH_MAX:
        raise ShapeError(
            "near_plane, far_plane",
            expected=f"{1 / DEPTH_MAX:g} <= near_plane < far_plane <= {DEPTH_MAX:g}",
            found=f"{near_plane}, {far_plane}",
            todo="correct the arguments",
        )
    if not 0 <= eps2d < EXTENT_MAX:
        raise ShapeError(
            "eps2d", expected=f"0 to {EXTENT_MAX:g}", found=str(eps2d), todo="correct the argument"
        )


def check_finite_inputs(arrays: dict[str, Tensor]) -> None:
    """Raise a ShapeError that names the first nan or infinite element."""
    for name, array in arrays.items():
        data = array.detach()
        if _all_finite(data):
            continue
        index = torch.nonzero(~torch.isfinite(data))[0].tolist()
        raise ShapeError(
            f"{name}{index}",
            expected="a finite number",
            found=str(data[tuple(index)].item()),
            todo="find where it comes from, or pass check_finite=False to cull such Gaussians",
        )


def _all_finite(data: Tensor) -> bool:
    """By numpy where it can: torch would wake its threads, which then spin for milliseconds and
    keep those of the kernels from their processors."""
    if data.device.type == "cpu" and data.dtype in (torch.float32, torch.float64):
        return bool(np.isfinite(data.numpy()).all())
    return bool(torch.isfinite(data).all())


def check_cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> None:
    """Raise a ShapeError that names the first camera that is mirrored, too wide or singular."""
    focals = Ks.detach().double().cpu().numpy()[:, [0, 1], [0, 1]]
    for camera in np.flatnonzero((focals <= 0).any(-1))[:1]:
        raise ShapeError(
            f"Ks[{camera}]",
            expected="positive focal lengths",
            found=str(focals[camera].tolist()),
            todo="mirror the camera by its pose, not by its intrinsics",
        )
    sizes = np.array([width, height])
    for camera in np.flatnonzero((focals < FOCAL_MIN * sizes).any(-1))[:1]:
        raise ShapeError(
            f"Ks[{camera}]",
            expected=f"focal lengths of at least {FOCAL_MIN:g} of the image's width and height",
            found=f"{focals[camera].tolist()} for {width} x {height} pixels",
            todo="give intrinsics in pixels",
        )
    volumes = np.linalg.det(viewmats.detach().double().cpu().numpy()[:, :3, :3])
    for camera in np.flatnonzero(volumes == 0)[:1]:
        raise ShapeError(
            f"viewmats[{camera}]",
            expected="a rotation in the upper left 3 x 3",
            found="a singular matrix",
            todo="pass world-to-camera transforms",
        )
