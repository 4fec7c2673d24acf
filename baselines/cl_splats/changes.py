"""Detection of pixels where a photo differs from the render of the model before it."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from baselines.cl_splats.config import CLSplatsConfig
from chronoscene.arrays import Mask
from chronoscene.images.masks import resize_mask

Image = NDArray[np.float32]

_WIDTH = 640
"""Pixels across the images that are compared at most: the smallest windows then have a standard
deviation of 4 pixels, and their time does not grow with the photos."""
_PATCH = 0.006
"""Standard deviation of the windows in which render and photo are compared, as a share of the width
of the image; those of a second scale are twice as wide."""
_STRUCTURE = 0.3  # Weight of 1 - structural similarity; chromaticity has weight 1
_CLEANING = 0.006  # Radius of the opening and the closing of masks, as a share of the width
_MIN_AREA = 0.0005  # Smaller spots are dropped; share of the area of the image
_ROUNDS = 4
"""Rounds of the fit of colours; each leaves out what the one before fits worse than most."""
_FIT_WIDTH = 80
"""Pixels across the image that the fit looks at."""
_DARK = 0.03
"""Added before logarithms, so that noise in the dark is no change."""
_FLAT = 0.03**2
"""Variance below which there is no structure."""


def changed_pixels(
    render: NDArray[np.floating],
    photo: NDArray[np.uint8],
    counts: Mask | None,
    config: CLSplatsConfig,
) -> Mask:
    """Find the pixels that have changed, by `change_mask` of images `_WIDTH` pixels wide at most.

    Args:
        render: 0..1. [H, W, 3]
        photo: [H, W, 3]
        counts: Where the photo counts; None for everywhere. [H, W]
        config: Threshold and sizes of the masks.
    """
    height, width = photo.shape[:2]
    render = np.asarray(render, np.float32)
    if width <= _WIDTH:
        return change_mask(change_scores(render, photo, counts), config)
    size = _WIDTH, max(round(height * _WIDTH / width), 1)

    def average(image: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA))

    counts = None if counts is None else resize_mask(counts, size)
    mask = change_mask(change_scores(average(render), average(photo), counts), config)
    large = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    return large.astype(bool)


def change_scores(
    render: NDArray[np.floating], photo: NDArray[np.uint8], counts: Mask | None
) -> Image:
    """Score of change of each pixel, 0 for none; the mean of two scales.

        chromaticity + 0.3 (1 - structure)

    Chromaticity is the sum over the channels of |l - mean l|, with l the difference of the
    logarithms of both images in a window: neither shadows nor darker surfaces are changes.
    Structure is the last factor of SSIM. Before, gain and offset of each channel of the render are
    fitted to the photo, so that a change of exposure or white balance is none of the scene.

    Args:
        render: 0..1. [H, W, 3]
        photo: [H, W, 3]
        counts: Where the photo counts; None for everywhere. The others have score 0. [H, W]
    """
    counts = np.ones(photo.shape[:2], bool) if counts is None else counts
    if not counts.any():
        return np.zeros(photo.shape[:2], np.float32)
    truth = (photo / 255).astype(np.float32)
    image = _in_colours_of(np.asarray(render, np.float32), truth, counts)
    truth[~counts] = image[~counts]
    total = np.zeros(photo.shape[:2], np.float32)
    for scale in (1, 2):
        sigma = _PATCH * scale * photo.shape[1]
        logs = [np.log(_blur(x, sigma).clip(0) + _DARK) for x in (truth, image)]
        difference = logs[0] - logs[1]
        total += np.abs(difference - difference.mean(-1, keepdims=True)).sum(-1)
        # What a short training leaves blurred is no change of structure.
        grey = [_blur(x, sigma / 2).mean(-1) for x in (truth, image)]
        total += _STRUCTURE * (1 - _structure(grey[0], grey[1], sigma))
    return np.where(counts, total / 2, 0.0)


def change_mask(scores: Image, config: CLSplatsConfig) -> Mask:
    """Pixels that have changed: a threshold, opening and closing, no small spots, dilation.

    Args:
        scores: [H, W]
        config: Threshold and sizes.
    """
    width = scores.shape[1]
    near = _disc(_CLEANING * width)
    # At the border everything goes on as it is there.
    mask = np.pad(scores >= config.change_threshold, len(near), mode="edge")
    mask = ndimage.binary_closing(ndimage.binary_opening(mask, near), near)
    mask = mask[len(near) : -len(near), len(near) : -len(near)]
    spots, count = ndimage.label(mask)
    areas = np.bincount(spots.ravel(), minlength=count + 1)
    mask &= (areas >= _MIN_AREA * scores.size)[spots]
    return np.asarray(ndimage.binary_dilation(mask, _disc(config.dilation * width)), bool)


def _in_colours_of(render: Image, photo: Image, counts: Mask) -> Image:
    """The render with the gain and offset of each channel that suit the photo where nothing
    changed."""
    every = max(photo.shape[1] // _FIT_WIDTH, 1)
    few, wanted, counted = (x[::every, ::every] for x in (render, photo, counts))
    if not counted.any():
        return render
    keep = counted
    for _ in range(_ROUNDS):
        source, target = few[keep], wanted[keep]
        mean, spread = source.mean(0), source - source.mean(0)
        # Flat images say nothing of the gain.
        gain = ((spread * target).mean(0) + 1e-4) / ((spread**2).mean(0) + 1e-4)
        gain = gain.clip(0.25, 4.0)
        offset = target.mean(0) - gain * mean
        error = np.abs(gain * few + offset - wanted).sum(-1)
        keep = counted & (error <= 1.5 * np.median(error[counted]))
    return np.asarray(gain * render + offset, np.float32)


def _structure(one: Image, other: Image, sigma: float) -> Image:
    """Covariance over variance, 1 where both are flat. [H, W]"""

    def blur(values: Image) -> Image:
        return np.asarray(ndimage.gaussian_filter(values, sigma))

    mean, mean2 = blur(one), blur(other)
    variances = blur(one * one) - mean**2 + blur(other * other) - mean2**2
    return (2 * (blur(one * other) - mean * mean2) + _FLAT) / (variances + _FLAT)


def _blur(image: Image, sigma: float) -> Image:
    return np.asarray(ndimage.gaussian_filter(image, (sigma, sigma, 0)))


def _disc(radius: float) -> Mask:
    """A disc as a structuring element; one pixel where the radius is below 1."""
    reach = int(radius)
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray(x**2 + y**2 <= radius**2)
