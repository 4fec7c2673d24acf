"""LDR-FLIP by its authors' package ``flip-evaluator``, which need not be installed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.metrics.psnr_ssim import masked_mean, unit_pair

PIXELS_PER_DEGREE = 67.02064
"""The authors' default: a screen 0.7 m wide with 3840 pixels, seen from 0.7 m."""


def flip(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
    """Mean LDR-FLIP: how far the two look apart when they alternate on a screen, 0 to 1.

    Args:
        image: sRGB. [H, W, 3]
        reference: sRGB. [H, W, 3]
        mask: Pixels that count. [H, W] bool

    Source: Andersson et al. 2020.
    """
    from flip_evaluator import evaluate

    test, photo = (x.astype(np.float32) for x in unit_pair(image, reference))
    settings = {"ppd": PIXELS_PER_DEGREE}
    errors, _, _ = evaluate(photo, test, "LDR", applyMagma=False, parameters=settings)
    return masked_mean(errors.astype(np.float64), mask)
