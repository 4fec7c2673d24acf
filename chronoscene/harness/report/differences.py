"""Differences between methods: one model of what test views and seeds leave open, for all at once.

A difference of two means has two errors. What the choice of test views leaves open is in the
resampled means of both (`intervals`). What seeds leave open is normal noise, independent for each
run, whose variance is pooled over methods: two seeds say little of a method's own spread.

Each error is drawn for all methods together, divided by its standard deviation as so few values
estimate it. The largest over all pairs, in 95 % of the draws, is the factor of the intervals; so
the best may be chosen by the same figures. As in a model confidence set (Hansen, Lunde & Nason
2011), methods that differ from the best are left out, and the others are compared once more.
"""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from chronoscene.arrays import Array
from chronoscene.harness.report.intervals import LEVEL, REPLICATES, SEED

TINY = np.finfo(float).tiny
FLOOR = 1e-6
"""Least estimate of a variance by a few draws, as a share of the true one."""


class SeedSpread(NamedTuple):
    """Spread of single runs over seeds."""

    variances: Array
    """Variance of each method; NaN if none has two seeds. [M]"""
    freedom: int
    """Seeds beyond the first of each method."""


def seed_spread(sds: ArrayLike, ns: ArrayLike) -> SeedSpread:
    """Pool sample standard deviations over ``ns`` seeds. [M] each; NaN for single seeds

    A method whose own spread is larger keeps that one.
    """
    squares, ns = np.square(np.asarray(sds, float)), np.asarray(ns)
    freedoms = np.where(np.isfinite(squares), ns - 1, 0)
    freedom = int(freedoms.sum())
    pooled = (freedoms * np.nan_to_num(squares)).sum() / freedom if freedom else np.nan
    return SeedSpread(np.fmax(squares, pooled), freedom)


def explained_by_seeds(spread: SeedSpread, ns: ArrayLike) -> Array:
    """Compute differences to the first method that seeds alone explain at 95 %, by a t-test.

    Args:
        spread: Of all methods.
        ns: Their seeds. [M]

    Returns:
        NaN where no method has two seeds. [M - 1]
    """
    from scipy.special import stdtrit

    own = spread.variances / np.asarray(ns)
    return stdtrit(spread.freedom or np.nan, (1 + LEVEL) / 2) * np.sqrt(own[0] + own[1:])


def margins(
    means: Array,
    resampled: Array,
    freedom: float,
    spread: SeedSpread,
    ns: ArrayLike,
    *,
    chosen: bool,
) -> Array:
    """Compute half the widths of the 95 % intervals of differences to the first method.

    Args:
        means: Of the first method, then of the others. [M]
        resampled: Their means of resampled views, paired. [M, REPLICATES]
        freedom: Degrees of freedom of the variance of these.
        spread: By seeds; without two seeds of any method, it is not in the intervals.
        ns: Seeds of the methods. [M]
        chosen: The first is the best of all; otherwise it was named beforehand.

    Returns:
        [M - 1]
    """
    m = len(means)
    pairs = [*combinations(range(m), 2)] if chosen else [(0, j) for j in range(1, m)]
    left, right = np.transpose(pairs)
    deviations = resampled - resampled.mean(axis=1, keepdims=True)
    errors, variances = _studentised(deviations[left] - deviations[right], freedom)
    if spread.freedom:
        rng = np.random.default_rng(SEED)
        own = spread.variances / np.asarray(ns)
        noise = rng.standard_normal((m, REPLICATES)) * np.sqrt(own)[:, None]
        noise /= np.sqrt(rng.chisquare(spread.freedom, REPLICATES) / spread.freedom)
        errors += noise[left] - noise[right]
        variances += own[left] + own[right]
    sds = np.sqrt(variances)
    ratios = np.abs(errors) / np.maximum(sds, TINY)[:, None]
    differences, of_first = np.abs(means[1:] - means[0]), sds[left == 0]
    near = np.ones(m, bool)
    while True:
        factor = np.quantile(ratios[near[left] & near[right]].max(axis=0), LEVEL)
        apart = differences > factor * of_first
        if apart.all() or not (apart & near[1:]).any():
            return factor * of_first
        near[1:] = ~apart


def _studentised(errors: Array, freedom: float) -> tuple[Array, Array]:
    """Scale errors by the true standard deviation over one that is estimated from few values.

    Args:
        errors: Of pairs of methods; drawn together. [..., REPLICATES]
        freedom: Number of these values; for each draw, as many other draws stand for them.

    Returns:
        errors: Studentised. [..., REPLICATES]
        variances: The true ones. [...]
    """
    squares = errors**2
    variances = squares.mean(axis=1)
    n = min(max(1, int(freedom)), REPLICATES // 2)
    sums = np.cumsum(np.concatenate([squares, squares[:, : n + 1]], axis=1), axis=1)
    estimated = (sums[:, n:-1] - sums[:, : -n - 1]) / n  # from the n draws that follow
    # Where the few are equal, nothing but rounding is left of their variance.
    estimated = np.maximum(estimated, FLOOR * variances[:, None] + TINY)
    return errors * np.sqrt(variances[:, None] / estimated), variances
