"""Uncertainty by test views: resampled means over views, and their intervals.

Neighbouring views show much the same, so ten of one place say less than ten of different places.
The means are therefore those of a block bootstrap: stretches of the path are drawn with
replacement, in each period for itself. Equal views are drawn alike for all methods, so that
differences of resampled means are paired (`differences`).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from zlib import crc32

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array
from chronoscene.formats.shared.grouping import natural_key

LEVEL = 0.95
REPLICATES = 2000
SEED = 0
CORRELATION = 0.3
"""Correlation of neighbouring views for which variances are without bias. Where it is smaller, they
are too large."""


def block_length(n: int) -> int:
    """Return the number of views in a block: the square root of all, rounded.

    Blocks have to grow with n, to hold what neighbours share, and so has their number. The length
    that is best for the variance of a mean grows as n^(1/3) (Hall, Horowitz & Jing 1995). With the
    5 to 100 test views of a period, and correlations of 0.3 to 0.8 between neighbours, intervals by
    the square root covered the mean more often, and as often where views were independent.
    """
    return max(1, round(math.sqrt(n)))


def resampled_means(values: Mapping[str, float], stratum: str) -> Array:
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
def resampling_weights(n: int, stream: int) -> Array:
    """Compute the weights of views in resampled means of a path; those of a mean add up to 1.

    Circular blocks (Politis & Romano 1992) of `block_length` views, n together. Such means vary too
    little: blocks are drawn around the mean of the few that there are, and neighbours in different
    blocks are drawn apart. The weights make up for both, if the correlation of views falls as
    `CORRELATION` to the power of their distance on the path.

    Returns:
        [REPLICATES, n]
    """
    length = block_length(n)
    blocks = -(-n // length)
    starts = np.random.default_rng([SEED, stream]).integers(n, size=(REPLICATES, blocks, 1))
    drawn = ((starts + np.arange(length)) % n).reshape(REPLICATES, -1)[:, :n]
    places = drawn + n * np.arange(REPLICATES)[:, None]
    shares = np.bincount(places.ravel(), minlength=REPLICATES * n).reshape(REPLICATES, n) / n
    alike = _correlations(n)
    found = (np.cov(shares.T) * alike).sum()
    return (shares - 1 / n) * math.sqrt(alike.mean() / found) + 1 / n


def _correlations(n: int) -> Array:
    """Return the correlations of the views of a path that weights make up for. [n, n]"""
    return CORRELATION ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))


@lru_cache
def degrees_of_freedom(n: int) -> float:
    """Compute the degrees of freedom of the variance of means of n views; NaN for a single view.

    The variance is x^T A x of the values x, with the covariance A of the weights. For normal values
    with covariance S it is spread as a chi-squared with tr(A S)^2 / tr(A S A S) of them.
    """
    if n < 2:
        return math.nan
    product = np.cov(resampling_weights(n, 0).T) @ _correlations(n)
    return float(np.trace(product) ** 2 / np.trace(product @ product))


def pooled_freedom(counts: Iterable[int], weights: Iterable[float] | None = None) -> float:
    """Compute the degrees of freedom of a weighted sum of means over so many views each.

    The formula is that of Satterthwaite (1946), for views that vary alike in all periods.

    Args:
        counts: Views of each period.
        weights: Weight of the mean of each period, up to a common factor; None for equal ones.
    """
    counts = [*counts]
    weights = [1.0] * len(counts) if weights is None else weights
    variances = [w**2 / n for n, w in zip(counts, weights, strict=True)]
    freedoms = map(degrees_of_freedom, counts)
    spread = math.fsum(v**2 / f for v, f in zip(variances, freedoms, strict=True))
    return math.fsum(variances) ** 2 / spread if counts else math.nan


def interval(resampled: Array, freedom: ArrayLike) -> tuple[Array, Array]:
    """Compute the ends of percentile intervals, widened by the ratio of t to normal quantiles.

    Args:
        resampled: Resampled means. [..., REPLICATES]
        freedom: Degrees of freedom of their variance. [...]

    Returns:
        The two ends. [...] each
    """
    from scipy.special import ndtri, stdtrit

    middle = resampled.mean(axis=-1)
    wider = stdtrit(freedom, (1 + LEVEL) / 2) / ndtri((1 + LEVEL) / 2)
    low, high = np.quantile(resampled, [(1 - LEVEL) / 2, (1 + LEVEL) / 2], axis=-1)
    return middle + (low - middle) * wider, middle + (high - middle) * wider
