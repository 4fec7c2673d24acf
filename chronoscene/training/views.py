"""Views of training steps: their order and number, and smaller versions of their photos."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import isqrt
from typing import Literal, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.kernels.runtime import views_for_threads
from chronoscene.kernels.thread_pool import num_workers
from chronoscene.methods import SparseDepths, TrainingSet, View
from chronoscene.methods.interface import HALVED_PIXELS, nothing_ahead
from chronoscene.training.devices import to_device

V = TypeVar("V", bound=View)

SHARE_OF_GPU = 0.25
"""Largest share for photos of the memory that a GPU has free at the start."""

COARSE_PIXELS = 320 * 240
"""Pixels of a view in which weights of Gaussians are measured, at least, if it has as many."""

AHEAD = 32
"""Number of draws that are known before they are made."""


class ViewSampler:
    """Sampler of view indices without replacement, from a pool that is refilled when empty.

    The order is a function of the seed and of the number of draws alone: pool number ``e`` is the
    permutation of a generator seeded with ``(seed, e)``. A resumed run sets `drawn` and continues
    as if it had never stopped, and nothing else can disturb the order.

    Args:
        count: Number of views to draw from.
        seed: Seed of the run.
        expect: `TrainingSet.expect`, called in each draw with its view and the next ones.
    """

    def __init__(
        self, count: int, seed: int, expect: Callable[[Sequence[int]], None] = nothing_ahead
    ) -> None:
        if count < 1:
            raise ValueError(f"count must be at least 1, not {count}")
        self.count = count
        self.seed = seed
        self.drawn = 0
        """Number of draws done; may be set to continue an interrupted run."""
        self._expect = expect
        self._pools: dict[int, NDArray[np.int64]] = {}

    def next(self) -> int:
        """Draw the index of the next view, 0..count-1."""
        draws = range(self.drawn, self.drawn + min(1 + AHEAD, self.count))
        views = [self._view(draw) for draw in draws]
        self._expect(views)
        self.drawn += 1
        return views[0]

    def _view(self, draw: int) -> int:
        """Return the index of the view of a draw, counted from 0."""
        pool, position = divmod(draw, self.count)
        if pool not in self._pools:
            generator = np.random.default_rng((self.seed, pool))
            self._pools.pop(pool - 2, None)  # Draws that are known at one time are of two pools
            self._pools[pool] = generator.permutation(self.count)
        return int(self._pools[pool][position])


class PhotosOnDevice:
    """Photos and masks of a training set as tensors; a GPU keeps those for which it has room.

    Args:
        train: The training set.
        device: Of the tensors.
    """

    def __init__(self, train: TrainingSet, device: torch.device) -> None:
        self._train, self._device = train, device
        self._kept: dict[tuple[str, int], Tensor] = {}
        self._room = 0
        if device.type == "cuda":
            self._room = int(SHARE_OF_GPU * torch.cuda.mem_get_info(device)[0])

    def photo(self, number: int) -> Tensor:
        """Return the photo of a view. uint8 [H, W, 3]"""
        if (known := self._kept.get(("photo", number))) is not None:
            return known
        return self._keep("photo", number, self._train.load_image(number))

    def mask(self, number: int) -> Tensor | None:
        """Return where the photo of a view counts; None for everywhere. bool [H, W]"""
        if (known := self._kept.get(("mask", number))) is not None:
            return known
        mask = self._train.load_mask(number)
        return None if mask is None else self._keep("mask", number, mask.copy())

    def _keep(self, kind: str, number: int, array: NDArray[np.generic]) -> Tensor:
        tensor = to_device(array, self._device)
        if tensor.nbytes <= self._room:
            self._kept[kind, number] = tensor
            self._room -= tensor.nbytes
        return tensor


class PhotoSizes:
    """Choice of the training set whose large photos are halved for the first share of a training.

    Args:
        train: The set with photos as they are, which is in use at first.
        share: Option `half_size_share`.
    """

    def __init__(self, train: TrainingSet, share: float) -> None:
        self._train, self._share, self._used = train, share, train
        self._halved = with_halved_photos(train) if share else train

    def change(self, progress: float) -> TrainingSet | None:
        """Return the set to learn from after a share of the training; None if it is in use."""
        due = self._halved if progress < self._share else self._train
        if due is self._used:
            return None
        self._used = due
        return due


def with_halved_photos(train: TrainingSet) -> TrainingSet:
    """Return the set with photos of `HALVED_PIXELS` at half of their width and height.

    A pixel counts where all four do, and has the depth of the nearest of their points.
    """
    large = [view.width * view.height >= HALVED_PIXELS for view in train.views]
    if not any(large):
        return train

    def load_image(i: int) -> NDArray[np.uint8]:
        image = train.load_image(i)
        return downscale_image(image, 2) if large[i] else image

    def load_mask(i: int) -> NDArray[np.bool_] | None:
        mask = train.load_mask(i)
        return _halved_mask(mask) if large[i] and mask is not None else mask

    def load_depths(i: int) -> SparseDepths:
        depths = train.load_depths(i)
        return _halved_depths(depths, train.views[i]) if large[i] else depths

    views = tuple(downscale_view(v, 2) if large[i] else v for i, v in enumerate(train.views))
    return replace(
        train, views=views, load_image=load_image, load_mask=load_mask, load_depths=load_depths
    )


def _halved_mask(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    height, width = (size // 2 * 2 for size in mask.shape)
    rows = mask[0:height:2, :width] & mask[1:height:2, :width]
    return rows[:, 0::2] & rows[:, 1::2]


def _halved_depths(depths: SparseDepths, view: View) -> SparseDepths:
    rows, columns = np.divmod(depths.pixels, view.width)
    rows, columns = rows // 2, columns // 2
    inside = (rows < view.height // 2) & (columns < view.width // 2)
    pixels, found = (rows * (view.width // 2) + columns)[inside], depths.depths[inside]
    order = np.lexsort((found, pixels))
    pixels, first = np.unique(pixels[order], return_index=True)
    return SparseDepths(pixels, found[order][first])


def count_views(option: int | Literal["auto"]) -> int:
    """Return the number of views of a step that an option asks for."""
    return views_for_threads(num_workers()) if option == "auto" else option


def views_of_step(most: int, index: int, progress: float) -> int:
    """Return the number of views of the next step: as many as usual, or what is left of a training.

    Args:
        most: The usual number.
        index: Views seen before.
        progress: Share of the training that is over.
    """
    if most == 1 or progress <= 0.0:
        return most
    return min(most, max(round(index / progress) - index, 1))


def is_due(index: int, views: int, interval: int) -> bool:
    """Return True if a multiple of an interval is among the views index + 1 .. index + views."""
    return (index + views) // interval > index // interval


def downscale_view(view: V, factor: int) -> V:
    """Return the view at 1/factor of its size; what fills no whole pixel is cut off.

    Pixel (0, 0) is centred at (0.5, 0.5), so image positions are divided by the factor.
    """
    K = view.K.copy()
    K[:2] /= factor
    width, height = max(view.width // factor, 1), max(view.height // factor, 1)
    return replace(view, K=K, width=width, height=height)


def coarse_view(view: V) -> V:
    """Return the view at the smallest 1/n of its size that has `COARSE_PIXELS`.

    That many show how much each Gaussian adds to a view, beside the others.
    """
    return downscale_view(view, max(isqrt(view.width * view.height // COARSE_PIXELS), 1))


def downscale_image(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Average squares of pixels, rounded; the result has the size of `downscale_view`.

    ``factor`` is the edge of a square in pixels; squares are smaller where the image is.
    """
    height, width = (max(size // factor, 1) for size in image.shape[:2])
    tall, wide = (min(factor, size) for size in image.shape[:2])
    # Sums of every n-th pixel: ten times as fast as a sum over axes of a reshaped array.
    sums = np.full((height, width, 3), tall * wide // 2, np.uint32)
    for row in range(tall):
        for column in range(wide):
            sums += image[row : height * tall : tall, column : width * wide : wide]
    return (sums // (tall * wide)).astype(np.uint8)
