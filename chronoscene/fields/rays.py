"""Pixels of all training photos, and the rays through them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.methods import TrainingView, View
from chronoscene.methods.interface import no_mask, nothing_ahead
from chronoscene.scene.geometry import camera_centre
from chronoscene.training import devices

MOST_PIXELS = 1 << 26
"""Pixels held at most: half a gigabyte. Of more, each photo gives a random part."""


class Rays(NamedTuple):
    """Rays in the training frame, and what they show."""

    origins: Tensor
    """float64 [R, 3]"""
    directions: Tensor
    """Unit vectors. [R, 3]"""
    depths: Tensor
    """z-depth of the place at distance 1. [R]"""
    views: Tensor
    """Number of the view of each ray in its pool. int64 [R]"""
    colors: Tensor
    """0..1. [R, 3]"""
    pixels: Tensor
    """Place in the image, 0..1. [R, 2]"""


def _pixel_to_world(view: View) -> NDArray[np.float64]:
    """Matrix from (u, v, 1) to a direction of z-depth 1."""
    found: NDArray[np.float64] = view.cam_from_world[:3, :3].T @ np.linalg.inv(view.K)
    return found


def _unit(directions: Tensor) -> tuple[Tensor, Tensor]:
    x, y, z = directions.unbind(1)
    lengths = torch.sqrt(x * x + y * y + z * z)
    return (directions / lengths[:, None]).float(), (1 / lengths).float()


def _on_image(pixels: Tensor, width: Tensor | int) -> tuple[Tensor, Tensor, Tensor]:
    """Places (u, v, 1) of pixels that are numbered row by row. float64 [R] each"""
    u, v = (x.double() + 0.5 for x in (pixels % width, pixels // width))
    return u, v, torch.ones_like(u)


def view_rays(view: View, pixels: Tensor) -> Rays:
    """Return rays through pixels of a view, numbered row by row; their colours are zero."""
    u, v, one = _on_image(pixels, view.width)
    image, matrix = torch.stack((u, v, one), dim=1), _pixel_to_world(view)
    places = torch.stack((u / view.width, v / view.height), dim=1).float()
    if devices.has_kernels(places):
        turned = torch.from_numpy(image.numpy() @ matrix.T)
    else:
        turned = image @ devices.to_device(matrix, pixels.device).T
    centre = devices.to_device(camera_centre(view.cam_from_world), pixels.device)
    nothing = torch.zeros_like(pixels), places.new_zeros(len(pixels), 3)
    return Rays(centre.expand(len(pixels), 3), *_unit(turned), *nothing, places)


class PixelPool:
    """Pixels of photos that training steps draw from; those that masks ignore are left out.

    Args:
        views: The photos' views.
        load_image: As `TrainingSet.load_image`.
        load_mask: As `TrainingSet.load_mask`.
        expect: As `TrainingSet.expect`.
        seed: Of the choice, if there are too many.
        device: Device of the pixels.
    """

    def __init__(
        self,
        views: Sequence[TrainingView],
        load_image: Callable[[int], NDArray[np.uint8]],
        load_mask: Callable[[int], NDArray[np.bool_] | None] = no_mask,
        *,
        expect: Callable[[Sequence[int]], None] = nothing_ahead,
        seed: int = 0,
        device: str = "cpu",
    ) -> None:
        self.views = tuple(views)
        most = MOST_PIXELS // max(len(views), 1)
        pixels, colors = [], []
        for i in range(len(self.views)):
            expect(range(i, min(i + 8, len(self.views))))
            image, mask = load_image(i), load_mask(i)
            chosen = np.arange(image.shape[0] * image.shape[1], dtype=np.int32)
            if mask is not None:
                chosen = chosen[mask.ravel()]
            if len(chosen) > most:
                generator = np.random.default_rng((seed, 1_001, i))
                chosen = np.sort(generator.choice(chosen, most, replace=False))
            pixels.append(chosen)
            colors.append(image.reshape(-1, 3)[chosen])
        self.counts = np.array([len(chosen) for chosen in pixels])
        """Pixels of each view. [V]"""
        self.ends = np.cumsum(self.counts)
        sizes = np.array([(view.width, view.height) for view in self.views])
        matrices = np.stack([_pixel_to_world(view) for view in self.views])
        centres = np.stack([camera_centre(view.cam_from_world) for view in self.views])
        arrays = self.ends, np.concatenate(pixels), np.concatenate(colors), sizes, matrices, centres
        self._ends, self._pixels, self._colors, self._sizes, self._matrices, self._centres = (
            devices.to_device(array, device) for array in arrays
        )
        periods = np.array([view.period for view in self.views], np.int64)
        self.periods = devices.to_device(periods, device)
        """Period of each view. [V]"""

    def __len__(self) -> int:
        return len(self._pixels)

    def draw(
        self, generator: np.random.Generator, count: int, of: NDArray[np.int64] | None = None
    ) -> Rays:
        """Draw rays of all views, or ``of`` some by their numbers, with replacement."""
        if of is None:
            chosen = devices.integers(generator, len(self), count, self._pixels)
        else:
            ends = np.cumsum(self.counts[of])
            chosen = devices.integers(generator, int(ends[-1]), count, self._pixels)
            of_some, moves = (
                devices.to_device(x, chosen.device) for x in (ends, self.ends[of] - ends)
            )
            chosen = chosen + moves[torch.searchsorted(of_some, chosen, right=True)]
        views = torch.searchsorted(self._ends, chosen, right=True)
        sizes, matrices = self._sizes[views], self._matrices[views]
        image = torch.stack(_on_image(self._pixels[chosen], sizes[:, 0]), dim=1)
        colors = self._colors[chosen].float() / 255
        if devices.has_kernels(colors):
            turned = torch.from_numpy(np.einsum("rij,rj->ri", matrices.numpy(), image.numpy()))
        else:
            turned = torch.einsum("rij,rj->ri", matrices, image)
        places = (image[:, :2] / sizes).float()
        return Rays(self._centres[views], *_unit(turned), views, colors, places)
