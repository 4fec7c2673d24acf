"""Drawing: from Gaussians, a view and a background to an image."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple
from weakref import WeakKeyDictionary

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.methods import Prediction, View
from chronoscene.rasterizer import Rasterization, rasterize
from chronoscene.scene.geometry import camera_centre
from chronoscene.training.config import SplattingConfig
from chronoscene.training.devices import to_device
from chronoscene.training.exposure import transformed

_BACKGROUND_STREAM, _DROPOUT_STREAM = 3, 10  # Keep what is drawn here apart from the rest


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


class Chance(NamedTuple):
    """Seed of the random choices for a view of a training step."""

    seed: int
    """Seed of the run."""
    draw: int
    """Number of the view among those drawn so far, from 1."""
    progress: float
    """Share of the training that is over."""

    def generator(self, stream: int) -> np.random.Generator:
        """Make the generator of one kind of choice."""
        return np.random.default_rng((self.seed, stream, self.draw))


def draw(
    splats: Splats,
    view: View,
    background: Tensor,
    *,
    near_plane: float,
    antialiased: bool = False,
    render_depth: bool = False,
    absgrad: bool = False,
    check_finite: bool = True,
) -> Rasterization:
    """Rasterize Gaussians in one view; arguments as `chronoscene.rasterizer.rasterize`."""
    return rasterize(
        *splats,
        *camera_tensors(view, splats.means.device),
        view.width,
        view.height,
        near_plane=near_plane,
        antialiased=antialiased,
        backgrounds=background[None],
        render_depth=render_depth,
        absgrad=absgrad,
        check_finite=check_finite,
    )


def weights_in(
    splats: Splats, view: View, pixels: Tensor, *, near_plane: float, antialiased: bool = False
) -> Tensor:
    """Sum, over the pixels of a view, the weight of each Gaussian times ``pixels``. [N, 3]

    The weight is transmittance times falloff times opacity: the factor of the colour.

    Args:
        splats: The Gaussians; their colours do not matter. [N]
        view: The camera.
        pixels: Three numbers for each pixel, such as 1 in a region and 0 elsewhere. [H, W, 3]
        near_plane: As for `draw`, like ``antialiased``.
    """
    with torch.enable_grad():
        colors = torch.zeros_like(splats.means).requires_grad_()
        raster = draw(
            splats._replace(colors=colors),
            view,
            torch.zeros(3, device=colors.device),
            near_plane=near_plane,
            antialiased=antialiased,
        )
        (gradient,) = torch.autograd.grad((raster.image[0] * pixels).sum(), colors)
    return gradient


def step_background(background: Tensor, config: SplattingConfig, chance: Chance) -> Tensor:
    """Return the colour behind everything in a view of a training step. [3] -> [3]

    Args:
        background: The usual colour.
        config: Asks for the usual colour or a random one.
        chance: Decides on a random one.
    """
    if not config.random_background:
        return background
    colour = chance.generator(_BACKGROUND_STREAM).random(3, np.float32)
    return to_device(colour, background.device)


def opacity_factors(opacities: Tensor, config: SplattingConfig, chance: Chance) -> Tensor | None:
    """Return what a step multiplies opacities by, to leave Gaussians out at random. [N] -> [N]

    These have 0, the others 1 / (1 - r), where r is the share of the former, which grows with the
    training: the mean opacity is as before (DropGaussian, Park et al. 2025).

    Args:
        opacities: Of the Gaussians.
        config: Asks for the share at the end of the training; None is returned where it is 0.
        chance: Decides which are left out.
    """
    share = config.opacity_dropout * min(chance.progress, 1.0)
    if share == 0:
        return None
    kept = chance.generator(_DROPOUT_STREAM).random(len(opacities), np.float32) >= share
    return to_device(kept * np.float32(1 / (1 - share)), opacities.device)


def draw_in_training(
    splats: Splats,
    view: View,
    background: Tensor,
    config: SplattingConfig,
    chance: Chance,
    *,
    render_depth: bool = False,
) -> Rasterization:
    """Draw a view in a training step, as the options ask for; arguments as `step_background`."""
    factors = opacity_factors(splats.opacities, config, chance)
    if factors is not None:
        splats = splats._replace(opacities=splats.opacities * factors)
    return draw(
        splats,
        view,
        step_background(background, config, chance),
        near_plane=config.near_plane,
        antialiased=config.antialiased,
        absgrad=config.absgrad,
        render_depth=render_depth,
        # What is not finite shows in the gradients; one such step ends no training.
        check_finite=False,
    )


def prediction_of(raster: Rasterization, exposure: Tensor | None = None) -> Prediction:
    """Make the prediction of a view that was drawn alone and with depth.

    Args:
        raster: The view.
        exposure: Transform of its colours. [3, 4]
    """
    assert raster.depths is not None
    image = raster.image[0] if exposure is None else transformed(raster.image[0], exposure)
    images = (image, raster.alphas[0, ..., 0], raster.depths[0, ..., 0])
    rgb, alpha, depth = (image.detach().cpu().numpy() for image in images)
    drawn = int((raster.info.radii[0] > 0).all(dim=-1).sum())
    return Prediction(rgb=rgb.clip(0.0, 1.0), alpha=alpha, depth=depth, drawn=drawn)


def camera_tensors(view: View, device: str | torch.device = "cpu") -> tuple[Tensor, Tensor]:
    """Return the world-to-camera transform and the intrinsics of a view, as a batch of one.

    Returns:
        viewmats: Pose in the training frame. float32 [1, 4, 4]
        Ks: Intrinsics in pixels. float32 [1, 3, 3]
    """
    pose = _of_view(view, device, "pose", lambda: np.array(view.cam_from_world, np.float32)[None])
    return pose, _of_view(view, device, "K", lambda: np.array(view.K, np.float32)[None])


def camera_centre_tensor(view: View, device: str | torch.device = "cpu") -> Tensor:
    """Compute the camera centre in the training frame, in float64. float32 [3]"""

    def centre() -> NDArray[np.float32]:
        pose = np.asarray(view.cam_from_world, dtype=np.float64)
        return camera_centre(pose).astype(np.float32)

    return _of_view(view, device, "centre", centre)


def camera_numbers(view: View, device: str | torch.device) -> Tensor:
    """Return the first three rows of the pose of a view, then fx, fy, cx and cy. float64 [16]"""

    def numbers() -> NDArray[np.float64]:
        inner = [view.K[0, 0], view.K[1, 1], view.K[0, 2], view.K[1, 2]]
        return np.concatenate([np.ravel(view.cam_from_world[:3]), inner]).astype(np.float64)

    return _of_view(view, device, "numbers", numbers)


_ON_GPU: WeakKeyDictionary[View, dict[tuple[str, torch.device], Tensor]] = WeakKeyDictionary()
"""Tensors of views, as a copy of a few numbers takes as long as one of many."""


def _of_view(
    view: View, device: str | torch.device, name: str, make: Callable[[], NDArray[np.generic]]
) -> Tensor:
    """Return a tensor of an array of a view, which a GPU gets once."""
    device = torch.device(device)
    if device.type == "cpu":
        return torch.from_numpy(make())
    kept, key = _ON_GPU.setdefault(view, {}), (name, device)
    if key not in kept:
        kept[key] = to_device(make(), device)
    return kept[key]
