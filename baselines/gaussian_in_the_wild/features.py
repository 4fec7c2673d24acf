"""Features that Gaussians read from the maps of a photo, and their initial coordinates there."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import grid_sample

from baselines.gaussian_in_the_wild.networks import MAPS
from chronoscene.methods import View
from chronoscene.training.drawing import camera_tensors
from chronoscene.training.views import downscale_image

_STREAM = 7  # Keeps the coordinates apart from other draws of the same seed
_UNKNOWN = 128
"""Value of pixels that do not count, for the network: the middle of its range."""


def start_coordinates(means: Tensor, box: float, seed: int) -> Tensor:
    """Initial coordinates of Gaussians in the maps; neighbours read near each other.

    Each axis of a free map is a random mixture of the axes of space, both -1..1; the projection map
    has the sides of a box instead.

    Args:
        means: Centres. [N, 3]
        box: Both sides, in the unit of `read_features`.
        seed: Of the run.

    Returns:
        Coordinates x and y in each free map, then width and height of the box. [N, 3, 2]
    """
    generator = np.random.default_rng((seed, _STREAM))
    weights = generator.random((MAPS - 1, 2, 3), np.float32)
    weights /= weights.sum(-1, keepdims=True)
    low, high = means.amin(0), means.amax(0)
    places = 2 * (means - low) / (high - low).clamp_min(1e-6) - 1
    mixed = (torch.from_numpy(weights).to(means.device)[..., None, :] * places).sum(-1)  # [2, 2, N]
    boxes = torch.full((len(means), 1, 2), box, device=means.device)
    return torch.cat([mixed.permute(2, 0, 1), boxes], 1)


def small_photo(
    photo: NDArray[np.uint8], mask: NDArray[np.bool_] | None, size: int
) -> NDArray[np.uint8]:
    """A photo as the network reads it, grey where it does not count. [H, W, 3] -> [h, w, 3]

    Args:
        photo: Left as it is.
        mask: Where it counts; None for everywhere. [H, W]
        size: About the longer side of the result in pixels; 0 for that of the photo.
    """
    if mask is not None:
        photo = np.where(mask[..., None], photo, np.uint8(_UNKNOWN))
    return downscale_image(photo, max(max(photo.shape[:2]) // size, 1) if size else 1)


def read_features(
    maps: Tensor, means: Tensor, coordinates: Tensor, view: View, *, box_in_pixels: bool
) -> tuple[Tensor, Tensor]:
    """Read the features of Gaussians from the maps of the photo of a view.

    A free map is read at a Gaussian's coordinates, -1..1. The projection map is read where the
    Gaussian is projected to, with the edges of its box as those of the map; outside of the box, and
    behind the camera, there is zero to read.

    Args:
        maps: The free ones, then the one to project into. [3, C, h, w]
        means: Centres in the training frame. [N, 3]
        coordinates: As of `start_coordinates`. [N, 3, 2]
        view: The camera of the photo.
        box_in_pixels: True if the sides of boxes count in pixels of the view, else in its sides.

    Returns:
        dynamic: Map by map. [N, 3 C]
        inside: True where a Gaussian is in front of the camera and within its box. bool [N]
    """
    viewmats, Ks = camera_tensors(view, means.device)
    viewmats, Ks = viewmats[0].to(means), Ks[0].to(means)
    x, y, z = (means @ viewmats[:3, :3].T + viewmats[:3, 3]).unbind(1)
    front = z > 0
    z = torch.where(front, z, 1.0)
    width, height = (1, 1) if box_in_pixels else (view.width, view.height)
    across = (Ks[0, 0] * x / z + Ks[0, 2]) / width
    down = (Ks[1, 1] * y / z + Ks[1, 2]) / height
    share = torch.stack([across, down], 1) / coordinates[:, -1]
    inside = front & (share > 0).all(1) & (share < 1).all(1)
    projected = torch.where(inside[:, None], 2 * share - 1, 0.0)
    at = torch.cat([coordinates[:, :-1], projected[:, None]], 1)
    read = grid_sample(
        maps, at.transpose(0, 1)[:, None], padding_mode="border", align_corners=False
    )[:, :, 0]  # [3, C, N]
    *free, last = read.transpose(1, 2)
    return torch.cat([*free, torch.where(inside[:, None], last, 0.0)], 1), inside
