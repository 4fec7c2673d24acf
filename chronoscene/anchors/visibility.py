"""Visibility: the anchors that a view can see, decided before anything is decoded.

Source: Scaffold-GS filters anchors by the radius of their projection as Gaussians with the
anchor's scale and no rotation; the projection is that of the rasterizer (EWA, Zwicker 2001).
"""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from torch import Tensor

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.methods import View
from chronoscene.rasterizer import constants
from chronoscene.rasterizer.constants import CLAMP_MARGIN, EPS2D, FAR_PLANE
from chronoscene.training import devices
from chronoscene.training.drawing import camera_numbers

_EXTENT = 3.33
"""Half width of a footprint in standard deviations: where an opacity of 1 falls below 1/255."""
_LARGE = 300.0
_SLACK = CLAMP_MARGIN / 2
"""Share of the image by which the linearised projection may look beyond its edges."""


def visible_anchors(
    anchors: Tensor, log_scales: Tensor, view: View, *, by: str = "radius", near_plane: float
) -> Tensor:
    """Return the indices of the anchors to decode, ascending. int64 [M]

    Args:
        anchors: Positions in the training frame. [A, 3]
        log_scales: Columns 0..2 are the logarithm of the anchor's extent. [A, 3 or more]
        view: The camera.
        by: ``radius``: the projected footprint touches the image; ``frustum``: the centre
            projects into it.
        near_plane: Anchors nearer than this are invisible.
    """
    anchors, log_scales = anchors.detach(), log_scales.detach()
    extent = _EXTENT if by == "radius" else 0.0
    if devices.has_gpu_kernels(anchors, log_scales):
        return _marked_on_gpu(anchors, log_scales, view, near_plane, extent).nonzero()[:, 0]
    if not devices.has_kernels(anchors, log_scales):
        return _marked(anchors, log_scales, view, near_plane, extent).nonzero()[:, 0]
    mask = np.empty(len(anchors), np.bool_)
    pose = np.ascontiguousarray(view.cam_from_world, dtype=np.float64)
    intrinsics = np.array([view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]])
    size = (float(view.width), float(view.height))
    arrays = anchors.numpy(), log_scales.numpy()
    _mark(*arrays, pose, intrinsics, size, near_plane, extent, mask)
    return torch.from_numpy(np.flatnonzero(mask))


def projected_centres(anchors: Tensor, view: View) -> Tensor:
    """Project anchors in front of a camera to pixels. [M, 3] -> float64 [M, 2]"""
    rays, _ = _from_camera(anchors, view)
    pixels = _turned(rays, devices.to_device(view.K.astype(np.float64), rays.device))
    return pixels[:, :2] / pixels[:, 2:]


def _from_camera(anchors: Tensor, view: View) -> tuple[Tensor, Tensor]:
    """Return anchors in the frame of a camera, float64 [M, 3], and its rotation."""
    pose = devices.to_device(view.cam_from_world.astype(np.float64), anchors.device)
    return _turned(anchors.double(), pose[:3, :3]) + pose[:3, 3], pose[:3, :3]


def _turned(vectors: Tensor, matrix: Tensor) -> Tensor:
    """Multiply each vector by a matrix, with equal bits for any number of threads. [M, 3]"""
    return (vectors[:, None] * matrix).sum(-1)


def _marked(anchors: Tensor, log_scales: Tensor, view: View, near: float, extent: float) -> Tensor:
    """Do what `_mark` does in plain torch: True for visible anchors. bool [A]"""
    rays, rotation = _from_camera(anchors, view)
    z, spreads = rays[:, 2], torch.exp(2.0 * log_scales[:, :3].double())
    visible = (z >= near) & (z <= FAR_PLANE)
    for axis, size in enumerate((view.width, view.height)):
        focal, centre = float(view.K[axis, axis]), float(view.K[axis, 2])
        ratio = rays[:, axis] / z
        low, high = -(centre + _SLACK * size) / focal, ((1.0 + _SLACK) * size - centre) / focal
        slope = ratio.clamp(low, high)
        jacobian = (focal / z)[:, None] * (rotation[axis] - slope[:, None] * rotation[2])
        radius = torch.ceil(extent * (EPS2D + (spreads * jacobian.square()).sum(-1)).sqrt())
        place = focal * ratio + centre
        visible &= (place + radius > 0.0) & (place - radius < size)
    return visible


def _marked_on_gpu(
    anchors: Tensor, log_scales: Tensor, view: View, near: float, extent: float
) -> Tensor:
    from chronoscene.anchors import visibility_gpu

    return visibility_gpu.marked(
        anchors,
        log_scales,
        camera_numbers(view, anchors.device),
        size=(view.width, view.height),
        depths=(near, FAR_PLANE),
        extent=extent,
        blur=EPS2D,
        slack=_SLACK,
    )


@inner
def _usual(log_scales):  # type: ignore[no-untyped-def]
    """Return True unless an extent is not a number, or too large for its square to be one."""
    return log_scales[0] < _LARGE and log_scales[1] < _LARGE and log_scales[2] < _LARGE


@kernel(parallel=True, extras=[constants])
def _mark(anchors, log_scales, pose, intrinsics, size, near, extent, mask):  # type: ignore[no-untyped-def]
    fx, fy, cx, cy = intrinsics
    width, height = size
    # The slope of a ray is held near the image before the projection is linearised, as in 3DGS.
    low_x, high_x = -(cx + _SLACK * width) / fx, ((1.0 + _SLACK) * width - cx) / fx
    low_y, high_y = -(cy + _SLACK * height) / fy, ((1.0 + _SLACK) * height - cy) / fy
    for i in prange(len(anchors)):
        px, py, pz = anchors[i, 0], anchors[i, 1], anchors[i, 2]
        z = pose[2, 0] * px + pose[2, 1] * py + pose[2, 2] * pz + pose[2, 3]
        mask[i] = False
        if z < near or z > FAR_PLANE:
            continue
        x = pose[0, 0] * px + pose[0, 1] * py + pose[0, 2] * pz + pose[0, 3]
        y = pose[1, 0] * px + pose[1, 1] * py + pose[1, 2] * pz + pose[1, 3]
        u, v = fx * x / z + cx, fy * y / z + cy
        if 0.0 < u < width and 0.0 < v < height and _usual(log_scales[i]):
            mask[i] = True  # however large the footprint
            continue
        # Diagonal of Sigma' = J W Sigma W^T J^T, as in 3DGS, plus the blur.
        slope_x = min(max(x / z, low_x), high_x)
        slope_y = min(max(y / z, low_y), high_y)
        variance_u, variance_v = EPS2D, EPS2D
        for axis in range(3):
            spread = np.exp(2.0 * log_scales[i, axis])
            ju = fx / z * (pose[0, axis] - slope_x * pose[2, axis])
            jv = fy / z * (pose[1, axis] - slope_y * pose[2, axis])
            variance_u += spread * ju * ju
            variance_v += spread * jv * jv
        ru, rv = np.ceil(extent * np.sqrt(variance_u)), np.ceil(extent * np.sqrt(variance_v))
        mask[i] = u + ru > 0.0 and u - ru < width and v + rv > 0.0 and v - rv < height
