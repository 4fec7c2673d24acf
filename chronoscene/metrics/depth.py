"""Errors of a rendered depth map where the true depth is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array
from chronoscene.checks import check_shape
from chronoscene.metrics.psnr_ssim import checked_mask, masked_mean

DELTA = 1.25
"""Ratio of depths below which a pixel counts as right."""


def depth_errors(
    depth: ArrayLike, truth: ArrayLike, mask: ArrayLike | None = None
) -> dict[str, float]:
    """Errors over the pixels that have a true depth.

    ``depth_abs_rel`` = mean |d - t| / t, ``depth_rmse`` = sqrt(mean (d - t)^2) in world units, and
    ``depth_delta`` = share of pixels with max(d / t, t / d) < 1.25. No scale is fitted. A pixel in
    which nothing was rendered has depth 0 and is wrong.

    Args:
        depth: z-depth in world units. [H, W]
        truth: The same; 0 where there is none, as in the sky. [H, W]
        mask: Pixels that count. [H, W] bool

    Raises:
        ShapeError: If no pixel that counts has a true depth.

    Source: Eigen et al. 2014.
    """
    t = np.asarray(truth, np.float64)
    d: Array = np.asarray(depth, np.float64)
    check_shape("depth", d, t.shape)
    known = (t > 0) if mask is None else (t > 0) & checked_mask(mask, t)
    t = np.where(known, t, 1.0)
    near = np.maximum(d, t) < DELTA * np.minimum(d, t)
    return {
        "depth_abs_rel": masked_mean(np.abs(d - t) / t, known),
        "depth_rmse": float(np.sqrt(masked_mean((d - t) ** 2, known))),
        "depth_delta": masked_mean(near.astype(np.float64), known),
    }
