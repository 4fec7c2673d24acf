"""Schedules: learning rates as functions of the progress of a training.

A schedule for all methods is added here. Each method names the rates of its tensors:
`AnchorMethod.rates` and `GaussianMethod.learning_rates`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

_COOLED = 0.1  # Factor of the learning rates at the end of a cooldown


def log_linear(progress: float, start: float, end: float) -> float:
    """Compute a learning rate that falls log-linearly: ``start^(1 - p) * end^p``.

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


def learning_rates(
    rates: Mapping[str, tuple[float, float]], progress: float, *, cooldown: float = 0.0
) -> dict[str, float]:
    """Compute the learning rates of a step, by name.

    Args:
        rates: Value at the start and at the end of each rate, which falls log-linearly.
        progress: Share of the training that is over.
        cooldown: As for `cooled`.
    """
    values = {rate: log_linear(progress, *rate) for rate in set(rates.values())}
    found = {name: values[rate] for name, rate in rates.items()}
    return cooled(found, progress, cooldown)


def cooled(rates: Mapping[str, float], progress: float, cooldown: float) -> dict[str, float]:
    """Lower the learning rates of a step, by name, in the last part of a training.

    Args:
        rates: What they would be.
        progress: Share of the training that is over.
        cooldown: Share of the training, its last, in which all rates fall further, log-linearly to
            a tenth of what they would be. 0: they stay as they are.
    """
    if not cooldown:
        return dict(rates)
    factor = log_linear(1.0 - (1.0 - progress) / cooldown, 1.0, _COOLED)
    return {name: rate * factor for name, rate in rates.items()}
