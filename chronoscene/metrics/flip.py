"""LDR-FLIP by its authors' package ``flip-evaluator``, which need not be installed."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.metrics.psnr_ssim import masked_mean, unit_pair

VIEWING = (0.7, 3840.0, 0.7)
"""The authors' default, 67 pixels per degree: distance in metres, width in pixels and in metres."""


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
    settings = {"vc": list(VIEWING)}
    errors, _, _ = evaluate(photo, test, "LDR", applyMagma=False, parameters=settings)
    return masked_mean(errors.astype(np.float64), mask)
