"""PSNR and SSIM after the colours of each image were fitted to those of its photo.

Test photos may differ from all training photos in exposure and white balance, which no model can
know. The fit takes such differences out of the score, and others of the same form with them: read
these metrics beside the raw ones, never in their place.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array
from chronoscene.metrics.psnr_ssim import checked_mask, psnr, ssim, unit_pair


def fit_colors(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> Array:
    """An image under the affine map of its colours that is nearest to the reference.

    corrected = clip(M [r, g, b, 1]^T, 0, 1), where M (3x4) minimises the squared error over the
    pixels that count. Where the map is not unique, as for an image of one colour, it is the one of
    least norm. Pixels that do not count become those of the reference.

    Args:
        image: [H, W, C]
        reference: [H, W, C]
        mask: Pixels that count. [H, W] bool

    Source: the colour correction of the released evaluation of Mip-NeRF 360 (Barron et al. 2022),
    which has quadratic terms as well and leaves saturated pixels out; that of RawNeRF (Mildenhall
    et al. 2022) is affine, but fits each channel alone, from the photo to the image.
    """
    a, b = unit_pair(image, reference)
    counted = np.ones(b.shape[:2], bool) if mask is None else checked_mask(mask, b)
    colors = np.dstack([a, np.ones(b.shape[:2])])
    transform = np.linalg.lstsq(colors[counted], b[counted])[0]
    return np.where(counted[..., None], np.clip(colors @ transform, 0.0, 1.0), b)


def psnr_cc(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
    """`psnr` after `fit_colors`; it is never below the raw one."""
    return psnr(fit_colors(image, reference, mask), reference, mask)


def ssim_cc(image: ArrayLike, reference: ArrayLike, mask: ArrayLike | None = None) -> float:
    """`ssim` after `fit_colors`."""
    return ssim(fit_colors(image, reference, mask), reference, mask)
