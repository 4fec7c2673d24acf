"""From Gaussians and a view to an image: what all methods that splat have in common."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from chronoscene.methods import Prediction, View
from chronoscene.rasterizer import Rasterization, rasterize
from chronoscene.scene.geometry import camera_centre


class Splats(NamedTuple):
    """Gaussians as the rasterizer draws them, in the training frame."""

    means: Tensor
    """Centres. [N, 3]"""
    quats: Tensor
    """Rotations wxyz. [N, 4]"""
    scales: Tensor
    """Standard deviations. [N, 3]"""
    opacities: Tensor
    """A Gaussian with an opacity of 0 or less is not drawn. [N]"""
    colors: Tensor
    """RGB. [N, 3]"""


def draw(
    splats: Splats,
    view: View,
    background: Tensor,
    *,
    near_plane: float,
    render_depth: bool = False,
    check_finite: bool = True,
) -> Rasterization:
    """Rasterize Gaussians in one view; arguments as `chronoscene.rasterizer.rasterize`."""
    viewmats, Ks = camera_tensors(view, splats.means.device)
    return rasterize(
        *splats,
        viewmats,
        Ks,
        view.width,
        view.height,
        near_plane=near_plane,
        backgrounds=background[None],
        render_depth=render_depth,
        check_finite=check_finite,
    )


def prediction_of(raster: Rasterization) -> Prediction:
    """What a method hands to the harness, from a call with one view and with depth."""
    assert raster.depths is not None
    images = (raster.image[0], raster.alphas[0, ..., 0], raster.depths[0, ..., 0])
    rgb, alpha, depth = (image.detach().cpu().numpy() for image in images)
    return Prediction(rgb=rgb.clip(0.0, 1.0), alpha=alpha, depth=depth)


def camera_tensors(view: View, device: str | torch.device = "cpu") -> tuple[Tensor, Tensor]:
    """World-to-camera transform and intrinsics of one view, as a batch of one.

    Returns:
        viewmats: Pose in the training frame. float32 [1, 4, 4]
        Ks: Intrinsics in pixels. float32 [1, 3, 3]
    """
    viewmats = torch.from_numpy(np.array(view.cam_from_world, dtype=np.float32)[None])
    Ks = torch.from_numpy(np.array(view.K, dtype=np.float32)[None])
    return viewmats.to(device), Ks.to(device)


def camera_centre_tensor(view: View, device: str | torch.device = "cpu") -> Tensor:
    """Camera centre in the training frame, computed in float64. float32 [3]"""
    centre = camera_centre(np.asarray(view.cam_from_world, dtype=np.float64))
    return torch.from_numpy(centre.astype(np.float32)).to(device)
