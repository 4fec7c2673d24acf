"""The one table of metric names. A name carries its variant; a number without one says nothing."""

from __future__ import annotations

from dataclasses import dataclass

from chronoscene.checks import check_choice


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """What tables and aggregates must know of a metric."""

    name: str
    title: str
    """Heading in tables, with the direction that is better."""
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
            "as ssim, but only where the window lies inside the image: scikit-image with "
            "gaussian_weights, sigma 1.5, use_sample_covariance False",
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
        ConfigError: If there is no such metric; names those that there are.
    """
    return METRICS[check_choice("--metric", name, METRICS)]
