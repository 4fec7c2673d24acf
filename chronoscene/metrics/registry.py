"""The one table of metrics, and their functions. A name carries the variant of the metric.

Other packages add metrics through the entry-point group ``chronoscene.metrics``, each a
`MetricInfo` with its function.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from importlib.util import find_spec
from pathlib import Path

from chronoscene.checks import check_choice, load_entry
from chronoscene.errors import ConfigError, MetricUnavailableError
from chronoscene.metrics.color_correction import psnr_cc, ssim_cc
from chronoscene.metrics.flip import flip
from chronoscene.metrics.lpips_weights import check_available
from chronoscene.metrics.psnr_ssim import IMAGE_METRICS


@dataclass(frozen=True, slots=True)
class MetricInfo:
    """Description of a metric for tables and aggregates."""

    name: str
    title: str
    """Heading in tables."""
    variant: str
    """Exact definition, in a sentence."""
    higher_is_better: bool
    decimals: int
    """Digits after the point in tables."""
    function: Callable[..., float] | None = None
    """``f(image, reference, mask)``, as in `Scorers`; None for `IMAGE_METRICS` and LPIPS."""
    on_request: bool = False
    """True if it is computed only where it is named."""
    package: str = ""
    """Package that it needs and that may be missing, as it is imported."""
    bounds: tuple[float, float] = (-1e3, 1e3)
    """Least and largest value that a view can have; the leaderboard refuses others."""


ENTRY_POINT_GROUP = "chronoscene.metrics"

METRICS = {
    info.name: info
    for info in (
        MetricInfo(
            "psnr",
            "PSNR [dB]",
            "10 log10(1 / MSE), one MSE over all channels of an 8-bit image; infinite for equal "
            "images; means are means of decibels",
            higher_is_better=True,
            decimals=2,
            bounds=(0.0, 100.0),
        ),
        MetricInfo(
            "ssim",
            "SSIM",
            "11x11 Gaussian window, sigma 1.5, per channel, zero padding at the border: the "
            "variant of 3DGS and of the papers that follow it",
            higher_is_better=True,
            decimals=4,
            bounds=(-1.0, 1.0),
        ),
        MetricInfo(
            "ssim_valid",
            "SSIM (valid)",
            "as ssim, but only where all of the window lies inside the image and counts: "
            "scikit-image with gaussian_weights, sigma 1.5, use_sample_covariance False",
            higher_is_better=True,
            decimals=4,
            bounds=(-1.0, 1.0),
        ),
        MetricInfo(
            "lpips_vgg",
            "LPIPS (VGG)",
            "LPIPS 0.1 with VGG16 on inputs in [-1, 1], as its authors define it",
            higher_is_better=False,
            decimals=4,
            bounds=(0.0, 2.0),
        ),
        MetricInfo(
            "lpips_vgg_3dgs",
            "LPIPS (VGG, 3DGS)",
            "LPIPS 0.1 with VGG16 on inputs in [0, 1]: the variant of 3DGS and of the papers that "
            "follow it",
            higher_is_better=False,
            decimals=4,
            bounds=(0.0, 2.0),
        ),
        MetricInfo(
            "psnr_cc",
            "PSNR (colours fitted) [dB]",
            "as psnr, after the affine map (3x4) of the colours of each image that brings it "
            "nearest to its photo",
            higher_is_better=True,
            decimals=2,
            bounds=(0.0, 100.0),
            function=psnr_cc,
            on_request=True,
        ),
        MetricInfo(
            "ssim_cc",
            "SSIM (colours fitted)",
            "as ssim, after the same map of the colours",
            higher_is_better=True,
            decimals=4,
            bounds=(-1.0, 1.0),
            function=ssim_cc,
            on_request=True,
        ),
        MetricInfo(
            "flip",
            "FLIP",
            "mean LDR-FLIP at 67 pixels per degree, by the package of its authors",
            higher_is_better=False,
            decimals=4,
            bounds=(0.0, 1.0),
            function=flip,
            on_request=True,
            package="flip_evaluator",
        ),
    )
}
"""Metric name to its description, for those that come with ChronoScene."""


@cache
def all_metrics() -> dict[str, MetricInfo]:
    """`METRICS` and those of other packages, in the order of tables.

    Raises:
        ConfigError: If one of these cannot be imported, or is not what it should be.
    """
    found = dict(METRICS)
    entries = entry_points(group=ENTRY_POINT_GROUP)
    for name in sorted(entries.names):
        info = load_entry(entries, name, "metric")
        if not isinstance(info, MetricInfo) or info.function is None or info.name != name:
            raise ConfigError(
                f"{ENTRY_POINT_GROUP}: {name}",
                expected=f"a MetricInfo of the name {name}, with a function",
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
    """Metrics that can be computed here, and the reasons for those that cannot."""

    functions: dict[str, Callable[..., float]]
    """Metric name to ``f(image, reference, mask)`` with [H, W, 3] uint8 images; the mask, bool
    [H, W], is None where all pixels count. Where it ignores, the images are equal."""
    skipped: dict[str, str]
    """Metric name to the reason for its absence."""
    unasked: frozenset[str] = frozenset()
    """Metrics that were not wanted: values of an earlier scoring hold."""


def make_scorers(
    names: Iterable[str] | None = None, *, lpips_weights: Path | None = None
) -> Scorers:
    """Prepare metrics; torch is imported only if LPIPS can be computed.

    Args:
        names: Metrics wanted; None for all but those on request.
        lpips_weights: Folder or file that the user named; then its absence is an error.

    Raises:
        ConfigError: If there is no such metric.
        MetricUnavailableError: If the user named weights that cannot be used.
    """
    known = all_metrics()
    if names is None:
        names = [name for name, info in known.items() if not info.on_request]
    wanted = [metric_info(name) for name in names]
    unasked = frozenset(known) - {info.name for info in wanted}
    skipped = {
        info.name: f"not installed: pip install {info.package}"
        for info in wanted
        if info.package and find_spec(info.package) is None
    }
    found = ((info.name, info.function or IMAGE_METRICS.get(info.name)) for info in wanted)
    functions = {name: f for name, f in found if f is not None and name not in skipped}
    perceptual = [info.name for info in wanted if info.name not in functions | skipped]
    if not perceptual:
        return Scorers(functions, skipped, unasked)
    try:
        check_available(lpips_weights)
        from chronoscene.metrics.lpips import lpips_metrics

        available = lpips_metrics(lpips_weights)
    except MetricUnavailableError as error:
        if lpips_weights is not None:
            raise
        place = f"{error.fields['place']}: {error.fields['found']}"
        reason = f"{place}; run chronoscene download lpips-weights"
        return Scorers(functions, skipped | dict.fromkeys(perceptual, reason), unasked)
    functions |= {name: available[name] for name in perceptual}
    return Scorers(functions, skipped, unasked)
