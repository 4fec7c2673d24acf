"""Views and photos at a fraction of their size, for the early part of a training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from chronoscene.methods import TrainingView


def coarser_view(view: TrainingView, factor: int) -> TrainingView:
    """The view at 1/factor of its size; rows and columns that fill no whole pixel are cut off.

    Pixel (0, 0) is centred at (0.5, 0.5), so image positions are divided by the factor.
    """
    K = view.K.copy()
    K[:2] /= factor
    width, height = max(view.width // factor, 1), max(view.height // factor, 1)
    return replace(view, K=K, width=width, height=height)


def coarser_image(image: NDArray[np.uint8], factor: int) -> NDArray[np.uint8]:
    """Mean over squares of pixels, rounded, of the size of `coarser_view`.

    Args:
        image: [H, W, 3]
        factor: Edge of a square in pixels; squares are smaller where the image is.
    """
    height, width = (max(size // factor, 1) for size in image.shape[:2])
    tall, wide = (min(factor, size) for size in image.shape[:2])
    # Sums of every n-th pixel: ten times as fast as a sum over axes of a reshaped array.
    sums = np.full((height, width, 3), tall * wide // 2, np.uint32)
    for row in range(tall):
        for column in range(wide):
            sums += image[row : height * tall : tall, column : width * wide : wide]
    return (sums // (tall * wide)).astype(np.uint8)
