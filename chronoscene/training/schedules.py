"""Schedules: learning rates as functions of the progress of a training."""

from __future__ import annotations

import math


def log_linear(progress: float, start: float, end: float) -> float:
    """A learning rate that falls log-linearly: ``start^(1 - p) * end^p``.

    Args:
        progress: Share of the training that is over; clamped to 0..1.
        start: Value at progress 0, above 0; or 0 together with `end` to switch it off.
        end: Value at progress 1.
    """
    p = min(max(progress, 0.0), 1.0)
    if start == 0.0 and end == 0.0:
        return 0.0
    if start <= 0.0 or end <= 0.0:
        raise ValueError(f"start and end must be positive, or both 0, not {start} and {end}")
    # The ends are exact: exp(log(x)) would miss them by a rounding.
    if p in (0.0, 1.0):
        return end if p else start
    return math.exp((1.0 - p) * math.log(start) + p * math.log(end))
