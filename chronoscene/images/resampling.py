"""Images resampled at given places, with the cubic filter of Catmull and Rom.

The filter reproduces straight lines and parabolas, so nothing moves. OpenCV's cubic filter (another
constant, places rounded to 1/32 pixel) moved points of light by 0.05 pixels.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from chronoscene.kernels.compilation import inner, kernel


@inner
def _weights(t: float, out: NDArray[np.float64]) -> None:
    """Weights of the four neighbours of a place a share ``t`` of the way between the middle two."""
    out[0] = t * (-0.5 + t * (1.0 - 0.5 * t))
    out[1] = 1.0 + t * t * (-2.5 + 1.5 * t)
    out[2] = t * (0.5 + t * (2.0 - 1.5 * t))
    out[3] = t * t * (-0.5 + 0.5 * t)


@kernel
def _warp(
    image: NDArray[np.uint8],
    x: NDArray[np.float32],
    y: NDArray[np.float32],
    out: NDArray[np.uint8],
) -> None:
    height, width, channels = image.shape
    wx, wy = np.empty(4), np.empty(4)
    for row in range(out.shape[0]):
        for column in range(out.shape[1]):
            u, v = x[row, column] - 0.5, y[row, column] - 0.5
            if not (math.isfinite(u) and math.isfinite(v)):
                out[row, column] = 0
                continue
            u, v = min(max(u, -2.0), width + 1.0), min(max(v, -2.0), height + 1.0)
            left, top = math.floor(u), math.floor(v)
            _weights(u - left, wx)
            _weights(v - top, wy)
            for channel in range(channels):
                total = 0.0
                for i in range(4):
                    source_row = min(max(top + i - 1, 0), height - 1)
                    line = 0.0
                    for j in range(4):
                        source_column = min(max(left + j - 1, 0), width - 1)
                        line += wx[j] * image[source_row, source_column, channel]
                    total += wy[i] * line
                out[row, column, channel] = min(max(math.floor(total + 0.5), 0), 255)


def warp(
    image: NDArray[np.uint8], x: NDArray[np.float32], y: NDArray[np.float32]
) -> NDArray[np.uint8]:
    """Resample an image; releases the interpreter's lock.

    Args:
        image: [H, W, C]
        x: Column in pixels to look at; pixel 0 is centred at 0.5. [H', W']
        y: Row. [H', W']

    Returns:
        Pixels beyond the border repeat it; black where a place is not finite. [H', W', C]
    """
    out = np.empty((*x.shape, image.shape[2]), np.uint8)
    _warp(np.ascontiguousarray(image), x, y, out)
    return out
