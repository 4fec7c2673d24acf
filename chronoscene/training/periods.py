"""From a period, possibly fractional, to the weights of the periods' features.

The weights mix features before the MLPs, so halfway between two periods is a model of its own and
not the mean of two images.

Quirks of the official code that are not repeated here: it truncates towards zero, so a period in
(-1, 0) extrapolates; between T - 1 and T it keeps only part of the last weight; and T is the number
of distinct ids of the split file, so ids with gaps break it. Periods outside 0..T-1 are refused.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.errors import ConfigError


def period_weights(period: float, num_periods: int) -> NDArray[np.float32]:
    """Compute e(t): one-hot for an integer t, linear between two neighbours otherwise. [T]

    Args:
        period: 0..T-1.
        num_periods: T.

    Raises:
        ConfigError: If the period is outside 0..T-1 or not a number.
    """
    if not 0.0 <= period <= num_periods - 1:
        raise ConfigError(
            "period",
            expected=f"a number within 0..{num_periods - 1}",
            found=str(period),
            todo="choose a period that the model was trained on, or a value between two of them",
        )
    lower = min(math.floor(period), num_periods - 1)
    share = period - lower
    weights = np.zeros(num_periods, np.float32)
    weights[lower] = 1.0 - share
    if share > 0.0:
        weights[lower + 1] = share
    return weights


def with_new_periods(rows: Tensor, count: int) -> Tensor:
    """Extend rows to all periods: new ones are copies of the last. [S, ...] -> [count, ...]"""
    return rows.detach()[[min(period, len(rows) - 1) for period in range(count)]]
