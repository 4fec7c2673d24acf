"""The one table of metrics, and their functions. A name carries the variant of the metric."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from chronoscene.checks import check_choice
from chronoscene.errors import MetricUnavailableError
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.metrics.psnr_ssim import IMAGE_METRICS


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """What tables and aggregates must know of a metric."""

    name: str
    title: str
    """Heading in tables."""
    variant: str
    """What exactly is computed, in a sentence."""
    higher_is_better: bool
    decimals: int
    """Digits after the point in tables."""


METRICS = {
    info.name: info
    for info in (
        MetricInfo(
            "psnr",
            "PSNR [dB]",
            "10 log10(1 / MSE), one MSE over all channels of an 8-bit image; infinite for equal "
            "images; means are means of decibels",
            True,
            2,
        ),
        MetricInfo(
            "ssim",
            "SSIM",
            "11x11 Gaussian window, sigma 1.5, per channel, zero padding at the border: the "
            "variant of 3DGS and of the papers that follow it",
            True,
            4,
        ),
        MetricInfo(
            "ssim_valid",
            "SSIM (valid)",
            "as ssim, but only where all of the window lies inside the image and counts: "
            "scikit-image with gaussian_weights, sigma 1.5, use_sample_covariance False",
            True,
            4,
        ),
        MetricInfo(
            "lpips_vgg",
            "LPIPS (VGG)",
            "LPIPS 0.1 with VGG16 on inputs in [-1, 1], as its authors define it",
            False,
            4,
        ),
        MetricInfo(
            "lpips_vgg_3dgs",
            "LPIPS (VGG, 3DGS)",
            "LPIPS 0.1 with VGG16 on inputs in [0, 1]: the variant of 3DGS and of the papers that "
            "follow it",
            False,
            4,
        ),
    )
}
"""Metric name to its description, in the order of tables."""


def metric_info(name: str) -> MetricInfo:
    """Description of a metric.

    Raises:
        ConfigError: If there is no such metric; the message lists the known ones.
    """
    return METRICS[check_choice("--metric", name, METRICS)]


@dataclass(frozen=True, slots=True)
class Scorers:
    """What can be computed, and why the rest cannot."""

    functions: dict[str, Callable[..., float]]
    """Metric name to ``f(image, reference, mask)`` with [H, W, 3] uint8 images; the mask, bool
    [H, W], is None where all pixels count. Where it ignores, the images are equal."""
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
        found = f"{error.fields['place']}: {error.fields['found']}"
        reason = f"{found}; run chronoscene download lpips-weights"
        return Scorers(functions, dict.fromkeys(perceptual, reason))
    return Scorers(functions | {name: available[name] for name in perceptual}, {})
