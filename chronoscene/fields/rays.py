"""Pixels of all training photos, and the rays through them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.methods import TrainingView, View
from chronoscene.methods.interface import no_mask, nothing_ahead
from chronoscene.scene.geometry import camera_centre

MOST_PIXELS = 1 << 26
"""Pixels held at most: half a gigabyte. Of more, each photo gives a random part."""


class Rays(NamedTuple):
    """Rays in the training frame, and what they show."""

    origins: NDArray[np.float64]
    """[R, 3]"""
    directions: NDArray[np.float32]
    """Unit vectors. [R, 3]"""
    depths: NDArray[np.float32]
    """z-depth of the place at distance 1. [R]"""
    views: NDArray[np.int64]
    """Number of the view of each ray in its pool. [R]"""
    colors: NDArray[np.float32]
    """0..1. [R, 3]"""
    pixels: NDArray[np.float32]
    """Place in the image, 0..1. [R, 2]"""


def _pixel_to_world(view: View) -> NDArray[np.float64]:
    """Matrix from (u, v, 1) to a direction of z-depth 1."""
    found: NDArray[np.float64] = view.cam_from_world[:3, :3].T @ np.linalg.inv(view.K)
    return found


def _unit(directions: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    lengths = np.linalg.norm(directions, axis=1, keepdims=True)
    return (directions / lengths).astype(np.float32), (1 / lengths[:, 0]).astype(np.float32)


def view_rays(view: View, pixels: NDArray[np.int64]) -> Rays:
    """Return rays through pixels of a view, numbered row by row; their colours are zero."""
    rows, columns = np.divmod(pixels, view.width)
    image = np.stack([columns + 0.5, rows + 0.5, np.ones(len(pixels))], axis=1)
    directions, depths = _unit(image @ _pixel_to_world(view).T)
    origins = np.broadcast_to(camera_centre(view.cam_from_world), (len(pixels), 3))
    nothing = np.zeros(len(pixels), np.int64), np.zeros((len(pixels), 3), np.float32)
    places = (image[:, :2] / [view.width, view.height]).astype(np.float32)
    return Rays(origins, directions, depths, *nothing, places)


class PixelPool:
    """Pixels of photos that training steps draw from; those that masks ignore are left out.

    Args:
        views: The photos' views.
        load_image: As `TrainingSet.load_image`.
        load_mask: As `TrainingSet.load_mask`.
        expect: As `TrainingSet.expect`.
        seed: Of the choice, if there are too many.
    """

    def __init__(
        self,
        views: Sequence[TrainingView],
        load_image: Callable[[int], NDArray[np.uint8]],
        load_mask: Callable[[int], NDArray[np.bool_] | None] = no_mask,
        *,
        expect: Callable[[Sequence[int]], None] = nothing_ahead,
        seed: int = 0,
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
        self._pixels = np.concatenate(pixels)
        self._colors = np.concatenate(colors)
        self._sizes = np.array([(view.width, view.height) for view in self.views])
        self._matrices = np.stack([_pixel_to_world(view) for view in self.views])
        self._centres = np.stack([camera_centre(view.cam_from_world) for view in self.views])
        self.periods = np.array([view.period for view in self.views], np.int64)
        """Period of each view. [V]"""

    def __len__(self) -> int:
        return len(self._pixels)

    def draw(
        self, generator: np.random.Generator, count: int, of: NDArray[np.int64] | None = None
    ) -> Rays:
        """Draw rays of all views, or ``of`` some by their numbers, with replacement."""
        if of is None:
            chosen = generator.integers(len(self), size=count)
        else:
            ends = np.cumsum(self.counts[of])
            chosen = generator.integers(ends[-1], size=count)
            chosen += (self.ends[of] - ends)[np.searchsorted(ends, chosen, side="right")]
        views = np.searchsorted(self.ends, chosen, side="right")
        rows, columns = np.divmod(self._pixels[chosen], self._sizes[views, 0])
        image = np.stack([columns + 0.5, rows + 0.5, np.ones(count)], axis=1)
        directions, depths = _unit(np.einsum("rij,rj->ri", self._matrices[views], image))
        colors = self._colors[chosen].astype(np.float32) / np.float32(255)
        places = (image[:, :2] / self._sizes[views]).astype(np.float32)
        return Rays(self._centres[views], directions, depths, views, colors, places)
