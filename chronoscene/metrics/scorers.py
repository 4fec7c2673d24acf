"""Metric functions by name, and the reason for each that this machine cannot compute."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from chronoscene.errors import MetricUnavailableError
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.metrics.names import METRICS, metric_info
from chronoscene.metrics.psnr_ssim import IMAGE_METRICS


@dataclass(frozen=True, slots=True)
class Scorers:
    """What can be computed, and why the rest cannot."""

    functions: dict[str, Callable[..., float]]
    """Metric name to ``f(image, reference)`` with [H, W, 3] uint8 images."""
    skipped: dict[str, str]
    """Metric name to the reason for its absence."""


def make_scorers(
    names: Iterable[str] = tuple(METRICS), *, lpips_weights: Path | None = None
) -> Scorers:
    """Prepare metrics; torch is imported only if LPIPS can be computed.

    Args:
        names: Metrics wanted.
        lpips_weights: Folder or file that the user named; then its absence is an error.

    Raises:
        ConfigError: If there is no such metric.
        MetricUnavailableError: If the user named weights that cannot be used.
    """
    wanted = [metric_info(name).name for name in names]
    functions = {name: IMAGE_METRICS[name] for name in wanted if name in IMAGE_METRICS}
    perceptual = [name for name in wanted if name not in functions]
    if not perceptual:
        return Scorers(functions, {})
    try:
        check_available(lpips_weights)
        from chronoscene.metrics.lpips import lpips_metrics

        available = lpips_metrics(lpips_weights)
    except MetricUnavailableError as error:
        if lpips_weights is not None:
            raise
        return Scorers(functions, dict.fromkeys(perceptual, str(error)))
    return Scorers(functions | {name: available[name] for name in perceptual}, {})
