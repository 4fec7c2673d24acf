"""PSNR and SSIM in float64, without torch.

Images are [H, W, C], uint8 0..255 or float 0..1; the data range is 1 after division by 255. A mask
[H, W] selects pixels of the error or similarity map, never of the input: zeroing the input would
score the mask's own edges and the black around them. A masked metric is the mean over the mask.
Windows of SSIM around pixels that count may reach beyond the mask, except those of `ssim_valid`.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.arrays import Array
from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError

WINDOW = 11  # Taps of the SSIM window per axis
SIGMA = 1.5  # Standard deviation of the SSIM window in pixels
_ROWS = 48  # Rows of a map of SSIM that are computed at a time
C1, C2 = 0.01**2, 0.03**2
"""Stabilisers of SSIM for data range 1 (Wang et al. 2004)."""


def unit_float(image: ArrayLike) -> Array:
    """An image in float64 0..1: uint8 is divided by 255, floats are taken as they are.

    Raises:
        ShapeError: If it is neither [H, W, C] nor of type uint8 or float, or empty, or not finite.
    """
    image = np.asarray(image)
    check_shape("image", image, (None, None, None))
    if not image.size:
        raise ShapeError("image", expected="pixels", found=str(image.shape), todo="pass an image")
    if image.dtype == np.uint8:
        return image.astype(np.float64) / 255.0
    if not np.issubdtype(image.dtype, np.floating) or not np.isfinite(image).all():
        found = str(image.dtype) if image.dtype.kind != "f" else "values that are not finite"
        raise ShapeError(
            "image", expected="uint8, or finite floats in 0..1", found=found, todo="convert it"
        )
    return image.astype(np.float64)


def psnr(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Peak signal-to-noise ratio in dB: -10 log10(MSE), one MSE over all channels.

    Equal images give ``inf``. That is the value of the formula and is kept, in the means too; JSON
    files hold it as the string ``"Infinity"``.

    Args:
        image: [H, W, C]
        reference: [H, W, C]
        mask: Pixels that count. [H, W] bool
    """
    a, b = unit_pair(image, reference)
    mse = masked_mean((a - b) ** 2, mask)
    return float("inf") if mse == 0 else float(-10.0 * np.log10(mse))


def ssim(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Structural similarity as 3DGS computes it: zeros are assumed beyond the border.

    Args:
        image: [H, W, C]
        reference: [H, W, C]
        mask: Pixels that count. [H, W] bool
    """
    return masked_mean(ssim_map(image, reference), mask)


def ssim_valid(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Structural similarity over the pixels whose whole window lies in the image and counts.

    Args:
        image: [H, W, C], at least 11 pixels per axis
        reference: [H, W, C]
        mask: Pixels that count. [H, W] bool

    Raises:
        ShapeError: If the image is smaller than the window, or no window counts as a whole.
    """
    values = ssim_map(image, reference)
    if min(values.shape[:2]) < WINDOW:
        raise ShapeError(
            "image",
            expected=f"at least {WINDOW} x {WINDOW} pixels for ssim_valid",
            found=f"{values.shape[1]} x {values.shape[0]}",
            todo="use the metric ssim, or evaluate larger images",
        )
    inside = slice(WINDOW // 2, -(WINDOW // 2))
    if mask is None:
        return masked_mean(values[inside, inside], None)
    import cv2

    counted = checked_mask(mask, values).astype(np.uint8)
    windows = cv2.erode(counted, np.ones((WINDOW, WINDOW), np.uint8))
    return masked_mean(values[inside, inside], windows[inside, inside])


def ssim_map(image: ArrayLike, reference: ArrayLike) -> Array:
    """SSIM of every pixel and channel, with zeros beyond the border. [H, W, C]

    S = (2 mu_a mu_b + C1)(2 cov_ab + C2) / ((mu_a^2 + mu_b^2 + C1)(var_a + var_b + C2)), where
    moments are taken under the Gaussian window and variances are E[a^2] - mu_a^2.

    Source: Wang et al. 2004, eq. 13.
    """
    a, b = unit_pair(image, reference)
    found, reach = np.empty_like(a), WINDOW // 2
    for start in range(0, len(a), _ROWS):  # a few rows at a time, which stay in the cache
        end, low = start + _ROWS, max(start - reach, 0)
        similar = _similarity(a[low : end + reach], b[low : end + reach])
        found[start:end] = similar[start - low : end - low]
    return found


def _similarity(a: Array, b: Array) -> Array:
    """`ssim_map` of two images of float64."""
    mu_a, mu_b = _blur(a), _blur(b)
    var_a = _blur(a * a) - mu_a * mu_a
    var_b = _blur(b * b) - mu_b * mu_b
    cov = _blur(a * b) - mu_a * mu_b
    numerator = (2 * mu_a * mu_b + C1) * (2 * cov + C2)
    denominator = (mu_a * mu_a + mu_b * mu_b + C1) * (var_a + var_b + C2)
    return numerator / denominator


def gaussian_window() -> Array:
    """The separable SSIM window along one axis; sums to 1. [11]"""
    x = np.arange(WINDOW) - WINDOW // 2
    weights = np.exp(-(x**2) / (2 * SIGMA**2))
    return np.asarray(weights / weights.sum())


def _blur(image: Array) -> Array:
    import cv2

    kernel = gaussian_window()
    blurred = cv2.sepFilter2D(
        np.ascontiguousarray(image), -1, kernel, kernel, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(blurred, dtype=np.float64).reshape(image.shape)


def unit_pair(image: ArrayLike, reference: ArrayLike) -> tuple[Array, Array]:
    """Two images of one shape by `unit_float`."""
    a, b = unit_float(image), unit_float(reference)
    check_shape("image", a, b.shape)
    return a, b


def checked_mask(mask: ArrayLike, values: Array) -> NDArray[np.bool_]:
    """A mask of the height and width of an image or a map. [H, W]"""
    mask = np.asarray(mask)
    check_shape("mask", mask, values.shape[:2])
    return mask.astype(bool)


def masked_mean(values: Array, mask: ArrayLike | None) -> float:
    """Mean of a map over the pixels that count.

    Raises:
        ShapeError: If none does.
    """
    if mask is None:
        return float(values.mean())
    selected = values[checked_mask(mask, values)]
    if not selected.size:
        raise ShapeError(
            "mask", expected="at least one pixel", found="none", todo="leave the region out"
        )
    return float(selected.mean())


IMAGE_METRICS: dict[str, Callable[..., float]] = {
    "psnr": psnr,
    "ssim": ssim,
    "ssim_valid": ssim_valid,
}
"""The metrics that need no weights."""
