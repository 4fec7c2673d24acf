"""The one table of metrics, and their functions. A name carries the variant of the metric.

Other packages add metrics through the entry-point group ``chronoscene.metrics``, each a
`MetricInfo` with its function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

from chronoscene.checks import check_choice
from chronoscene.errors import ConfigError, MetricUnavailableError
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
    function: Callable[..., float] | None = None
    """``f(image, reference, mask)``, as in `Scorers`; None for the metrics here."""


ENTRY_POINT_GROUP = "chronoscene.metrics"

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
"""Metric name to its description, for those that come with ChronoScene."""


@cache
def all_metrics() -> dict[str, MetricInfo]:
    """`METRICS` and those of other packages, in the order of tables.

    Raises:
        ConfigError: If one of these is not what it should be.
    """
    found = dict(METRICS)
    for entry in sorted(entry_points(group=ENTRY_POINT_GROUP), key=lambda e: e.name):
        info = entry.load()
        if not isinstance(info, MetricInfo) or info.function is None or info.name != entry.name:
            raise ConfigError(
                f"{ENTRY_POINT_GROUP}: {entry.name}",
                expected=f"a MetricInfo of the name {entry.name}, with a function",
                found=repr(info),
                todo="correct the package, or uninstall it",
            )
        found.setdefault(info.name, info)
    return found


def metric_info(name: str) -> MetricInfo:
    """Description of a metric.

    Raises:
        ConfigError: If there is no such metric; the message lists the known ones.
    """
    return all_metrics()[check_choice("--metric", name, all_metrics())]


@dataclass(frozen=True, slots=True)
class Scorers:
    """What can be computed, and why the rest cannot."""

    functions: dict[str, Callable[..., float]]
    """Metric name to ``f(image, reference, mask)`` with [H, W, 3] uint8 images; the mask, bool
    [H, W], is None where all pixels count. Where it ignores, the images are equal."""
    skipped: dict[str, str]
    """Metric name to the reason for its absence."""


def make_scorers(
    names: Iterable[str] | None = None, *, lpips_weights: Path | None = None
) -> Scorers:
    """Prepare metrics; torch is imported only if LPIPS can be computed.

    Args:
        names: Metrics wanted; None for all.
        lpips_weights: Folder or file that the user named; then its absence is an error.

    Raises:
        ConfigError: If there is no such metric.
        MetricUnavailableError: If the user named weights that cannot be used.
    """
    wanted = [metric_info(name) for name in (all_metrics() if names is None else names)]
    known = ((info.name, info.function or IMAGE_METRICS.get(info.name)) for info in wanted)
    functions = {name: function for name, function in known if function is not None}
    perceptual = [info.name for info in wanted if info.name not in functions]
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
