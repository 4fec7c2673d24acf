"""The loss of `ssim_kernel` in plain torch, with its gradient: what a GPU runs.

The maps and their names are those of `ssim_kernel`. The blur is two passes over the image, all maps
at once. It is a convolution of each map by itself, without cuDNN, so that nothing is rounded to
TF32.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from chronoscene.training.devices import to_device
from chronoscene.training.photometric.ssim_kernel import C1, C2, RADIUS, TAPS

_TAPS = np.array(TAPS, np.float32)


def l1_ssim(image: Tensor, target: Tensor, weights: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Weighted sum of the sums of |x - y| and 1 - S over all numbers, and its gradient in x.

    Args:
        image: x. float32 [H, W, 3]
        target: y. float32 [H, W, 3]
        weights: Of the two sums.

    Returns:
        value: A scalar.
        gradient: [H, W, 3]
    """
    x, y = image.movedim(-1, 0), target.movedim(-1, 0)
    mu, nu, squares, gaps = _blur(torch.stack([x, y, x * x + y * y, (x - y).square()])).unbind()
    e = mu - nu
    both_squares = mu * mu + nu * nu
    # Rounding must not take a variance below 0, nor var(x - y) above 2 var(x) + 2 var(y).
    variance = (squares - both_squares).clamp_min(0)
    v = torch.minimum((gaps - e * e).clamp_min(0), 2 * variance)
    over_c, over_d = 1 / (both_squares + float(C1)), 1 / (variance + float(C2))
    v_over_d = v * over_d
    ratio = (both_squares + float(C1) - e * e) * over_c
    both = ratio * over_d
    a = e * over_c * (1 - v_over_d) * (1 - mu * e * over_c) - both * (e - mu * v_over_d)
    first, second, third = _blur(torch.stack([2 * a, -both * v_over_d, both])).unbind()
    slope = first + 2 * x * second + 2 * (x - y) * third
    gradient = weights[0] * (x - y).sign() + weights[1] * slope
    dissimilarity = (e * e * over_c + ratio * v_over_d).sum()
    value = weights[0] * (x - y).abs().sum() + weights[1] * dissimilarity
    return value, gradient.movedim(0, -1).contiguous()


def _blur(maps: Tensor) -> Tensor:
    """Gaussian window of each map with zero padding. [M, 3, H, W]"""
    taps = to_device(_TAPS, maps.device)
    planes = maps.flatten(0, 1)[None]
    count = planes.shape[1]
    with torch.backends.cudnn.flags(enabled=False):
        for shape, padding in (((1, -1), (0, RADIUS)), ((-1, 1), (RADIUS, 0))):
            window = taps.view(1, 1, *shape).repeat(count, 1, 1, 1)
            planes = conv2d(planes, window, padding=padding, groups=count)
    return planes.view(maps.shape)
