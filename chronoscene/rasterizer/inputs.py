"""Arguments of a backend and their checks: shapes always, finite numbers unless switched off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.rasterizer.constants import (
    DEPTH_MAX,
    EPS2D,
    EXTENT_MAX,
    FAR_PLANE,
    FOCAL_MIN,
    NEAR_PLANE,
    SIZE_MAX,
)


@dataclass(frozen=True, slots=True, eq=False)
class Inputs:
    """Arguments of `chronoscene.rasterizer.rasterize`, which describes them."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    near_plane: float = NEAR_PLANE
    far_plane: float = FAR_PLANE
    eps2d: float = EPS2D
    backgrounds: Tensor | None = None
    render_depth: bool = False
    absgrad: bool = False
    antialiased: bool = False

    @property
    def gaussians(self) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Means, quats, scales, opacities, colors."""
        return self.means, self.quats, self.scales, self.opacities, self.colors


def recentred(means: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Move the origin to the first camera, so that a cast to float32 loses nothing that counts.

    Survey coordinates are millions of metres; float32 has seven digits. The images are the same,
    and so are all gradients.

    Args:
        means: Centres in world units. [N, 3]
        viewmats: World-to-camera transforms. [C, 4, 4]

    Returns:
        means: In their own float type. [N, 3]
        viewmats: float64. [C, 4, 4]
    """
    viewmats = viewmats.detach().double()
    if len(viewmats) == 0:
        return means, viewmats
    rotation, translation = viewmats[0, :3, :3], viewmats[0, :3, 3]
    centre = -torch.linalg.solve_ex(rotation, translation).result
    # What is subtracted from the means and what is added to the cameras must be the same number.
    origin = torch.where(torch.isfinite(centre).all(), centre, 0).to(means.dtype)
    moved = viewmats.clone()
    moved[:, :3, 3] += viewmats[:, :3, :3] @ origin.double()
    return means - origin, moved


def check_inputs(inputs: Inputs, finite: bool) -> None:
    """Raise a ShapeError that names the first argument that is wrong.

    Args:
        inputs: What to check.
        finite: Whether to look for nan, infinite numbers and invalid cameras too.
    """
    names = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks")
    arrays = {name: getattr(inputs, name) for name in names}
    _check_size(inputs)
    _check_shapes(arrays, inputs.backgrounds)
    _check_options(inputs)
    if finite:
        if inputs.backgrounds is not None:
            arrays["backgrounds"] = inputs.backgrounds
        _check_finite(arrays)
        _check_cameras(inputs.viewmats, inputs.Ks, inputs.width, inputs.height)


def _require(holds: bool, place: str, expected: str, found: object, todo: str) -> None:
    if not holds:
        raise ShapeError(place, expected=expected, found=str(found), todo=todo)


def _check_shapes(arrays: dict[str, Tensor], backgrounds: Tensor | None) -> None:
    for name, array in arrays.items():
        _require(
            array.is_floating_point(), name, "floating point", array.dtype, todo="call .float()"
        )
    count, cameras = len(arrays["means"]), len(arrays["viewmats"])
    _require(cameras > 0, "viewmats", "at least one camera", "none", todo="pass those to draw")
    shapes: dict[str, tuple[int | None, ...]] = {
        "means": (count, 3),
        "quats": (count, 4),
        "scales": (count, 3),
        "opacities": (count,),
        "colors": (count, None),
        "viewmats": (cameras, 4, 4),
        "Ks": (cameras, 3, 3),
    }
    for name, shape in shapes.items():
        check_shape(name, arrays[name], shape)
    if backgrounds is not None:
        check_shape("backgrounds", backgrounds, (cameras, arrays["colors"].shape[1]))


def check_settings(inputs: Inputs) -> None:
    """Raise a ShapeError if the size of the image or an option is wrong, whatever the tensors."""
    _check_size(inputs)
    _check_options(inputs)


def _check_size(inputs: Inputs) -> None:
    for name, size in (("width", inputs.width), ("height", inputs.height)):
        todo = "correct the argument, or render a larger image in parts"
        whole = isinstance(size, int | np.integer) and 1 <= size <= SIZE_MAX
        _require(whole, name, f"1 to {SIZE_MAX} whole pixels", size, todo)


def _check_options(inputs: Inputs) -> None:
    near, far, channels = inputs.near_plane, inputs.far_plane, inputs.colors.shape[1]
    _require(
        1 / DEPTH_MAX <= near < far <= DEPTH_MAX,
        "near_plane, far_plane",
        f"{1 / DEPTH_MAX:g} <= near_plane < far_plane <= {DEPTH_MAX:g}",
        f"{near}, {far}",
        todo="correct the arguments",
    )
    limits = f"0 to {EXTENT_MAX:g}"
    _require(0 <= inputs.eps2d < EXTENT_MAX, "eps2d", limits, inputs.eps2d, "correct the argument")
    _require(
        not inputs.absgrad or (channels == 3 and not inputs.render_depth),
        "absgrad",
        "three channels without depth",
        f"{channels} channels, render_depth={inputs.render_depth}",
        todo="render the others in a call of their own",
    )


def _check_finite(arrays: dict[str, Tensor]) -> None:
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


def _check_cameras(viewmats: Tensor, Ks: Tensor, width: int, height: int) -> None:
    """No camera may have skew or mirrored intrinsics, be too wide or singular."""
    intrinsics = Ks.detach().double().cpu().numpy()
    focals = intrinsics[:, [0, 1], [0, 1]]
    others = intrinsics[:, [0, 1, 2, 2, 2], [1, 0, 0, 1, 2]] - [0, 0, 0, 0, 1]
    least = FOCAL_MIN * np.array([width, height])
    volumes = np.linalg.det(viewmats.detach().double().cpu().numpy()[:, :3, :3])
    for camera, (focal, volume) in enumerate(zip(focals, volumes, strict=True)):
        _require(
            not others[camera].any(),
            f"Ks[{camera}]",
            "[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]",
            intrinsics[camera].tolist(),
            todo="undistort images of cameras with skew, and divide by the last number",
        )
        _require(
            (focal > 0).all(),
            f"Ks[{camera}]",
            "positive focal lengths",
            focal.tolist(),
            todo="mirror the camera by its pose, not by its intrinsics",
        )
        _require(
            (focal >= least).all(),
            f"Ks[{camera}]",
            f"focal lengths of at least {FOCAL_MIN:g} of the image's width and height",
            f"{focal.tolist()} for {width} x {height} pixels",
            todo="give intrinsics in pixels",
        )
        _require(
            volume != 0,
            f"viewmats[{camera}]",
            "a rotation in the upper left 3 x 3",
            "a singular matrix",
            todo="pass world-to-camera transforms",
        )
