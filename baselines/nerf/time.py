"""Codes of the time t, from 0 at the first period to 1 at the last."""

from __future__ import annotations

import torch
from torch import Tensor

LEAST_WIDTH = 1e-3
FIRST_WIDTH = 0.3


def step_code(t: Tensor, centres: Tensor, widths: Tensor) -> Tensor:
    """Evaluate learned step functions: hard steps, with the slope of smooth ones.

    The smooth step is the cumulative Laplace distribution around the centre u with the width
    b = max(|b|, 1e-3): exp(-(u - t) / b) / 2 below u, 1 - exp(-(t - u) / b) / 2 above.

    Source: Lin et al. 2023, "Neural Scene Chronology", section 3.3.

    Args:
        t: [R]
        centres: [J]
        widths: [J]

    Returns:
        0 or 1. [R, J]
    """
    away = t[:, None] - centres
    width = widths.abs().clamp_min(LEAST_WIDTH)
    below = torch.exp(away.clamp_max(0) / width) / 2
    above = 1 - torch.exp(-away.clamp_min(0) / width) / 2
    smooth = torch.where(away < 0, below, above)
    return (away >= 0).to(smooth) + (smooth - smooth.detach())
