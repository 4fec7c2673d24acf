"""Uncertainty by test views and seeds: intervals of means over views, and of differences.

Neighbouring views show much the same, so ten of one place say less than ten of different places.
The interval over views is therefore a block bootstrap: stretches of the path are drawn with
replacement, in each period for itself. Equal views are drawn alike for all methods, so that
differences of resampled means are paired.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.formats.shared.grouping import natural_key

LEVEL = 0.95
REPLICATES = 2000
SEED = 0


def block_length(n: int) -> int:
    """Return the number of views in a block: the square root of all, rounded.

    Blocks have to grow with n, to hold what neighbours share, and so has their number. The length
    that is best for the variance of a mean grows as n^(1/3) (Hall, Horowitz & Jing 1995). With the
    5 to 100 test views of a period, and correlations of 0.3 to 0.8 between neighbours, intervals by
    the square root covered the mean more often, and as often where views were independent.
    """
    return max(1, round(math.sqrt(n)))


def resampled_means(values: Mapping[str, float], stratum: str) -> NDArray[np.float64]:
    """Compute means of resampled views. [REPLICATES]

    The draws depend on ``stratum`` and the names of the views alone.

    Args:
        values: Name of a view to its value. The path is the natural order of the names, closed to a
            circle.
        stratum: Scene and period: views of different ones are drawn independently.

    Returns:
        NaN where nothing can be said: for a single view, and for values that are not finite.
    """
    views = sorted(values, key=natural_key)
    on_path = np.array([values[view] for view in views])
    if len(views) < 2 or not np.isfinite(on_path).all():
        return np.full(REPLICATES, np.nan)
    return resampling_weights(len(views), crc32("\n".join([stratum, *views]).encode())) @ on_path


@lru_cache(maxsize=64)
def resampling_weights(n: int, stream: int) -> NDArray[np.float64]:
    """Compute the weights of views in resampled means of a path; those of a mean add up to 1.

    Circular blocks (Politis & Romano 1992) of L_1 to L_k views, n together. For independent views
    the variance of such means is the wanted one times 1 - sum L_i^2 / n^2, which the weights make
    up for; with blocks of one view that is the usual factor n / (n - 1).

    Returns:
        [REPLICATES, n]
    """
    length = block_length(n)
    lengths = np.full(-(-n // length), length)
    lengths[-1] -= lengths.sum() - n
    starts = np.random.default_rng([SEED, stream]).integers(n, size=(REPLICATES, len(lengths), 1))
    drawn = ((starts + np.arange(length)) % n).reshape(REPLICATES, -1)[:, :n]
    places = drawn + n * np.arange(REPLICATES)[:, None]
    shares = np.bincount(places.ravel(), minlength=REPLICATES * n).reshape(REPLICATES, n) / n
    return (shares - 1 / n) / math.sqrt(1 - (lengths**2).sum() / n**2) + 1 / n


def interval(resampled: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Compute the ends of percentile intervals. [..., REPLICATES] to [...] each"""
    low, high = np.quantile(resampled, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=-1)
    return low, high


def seed_margin(sds: ArrayLike, ns: ArrayLike, sd: float, n: int) -> NDArray[np.float64]:
    """Compute differences between means over seeds that chance explains, by Welch's t-test.

    Args:
        sds: Sample standard deviations of some methods. [M]
        ns: How many seeds each of them has. [M]
        sd: That of the method they are compared with.
        n: How many seeds that one has.

    Returns:
        NaN where a method has one seed, or nothing is spread. [M]
    """
    from scipy.special import stdtrit

    ns = np.asarray(ns)
    variances, variance = np.square(sds) / ns, sd**2 / n
    with np.errstate(invalid="ignore", divide="ignore"):
        total = variances + variance
        freedom = total**2 / (variances**2 / (ns - 1) + variance**2 / (n - 1))
    return stdtrit(freedom, (1 + LEVEL) / 2) * np.sqrt(total)
