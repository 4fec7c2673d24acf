"""Intervals: coverage on paths whose mean is known, closed forms, what is drawn alike."""

from itertools import permutations

import numpy as np
import pytest
from made_runs import smooth

from chronoscene.harness.report import intervals
from chronoscene.harness.report.intervals import (
    CORRELATION,
    block_length,
    degrees_of_freedom,
    interval,
    pooled_freedom,
    resampled_means,
    resampling_weights,
)


def coverage(correlation, periods=3, views=40, paths=200):
    """Share of paths whose interval holds the true mean, 0; a few paths share their draws."""
    found = 0
    rng = np.random.default_rng(0)
    for i, path in enumerate(smooth(rng, (paths, periods, views), correlation)):
        named = [{f"{k}.png": value for k, value in enumerate(values)} for values in path]
        means = [resampled_means(values, f"{i % 10}/{k}") for k, values in enumerate(named)]
        low, high = interval(np.mean(means, axis=0), pooled_freedom([views] * periods))
        found += low <= 0 <= high
    return found / paths


@pytest.mark.parametrize("views", [6, 40])
@pytest.mark.parametrize("correlation", [0.0, 0.3])
def test_the_interval_covers_the_mean(correlation, views):
    assert 0.92 <= coverage(correlation, views=views) <= 1


def test_single_views_would_not_cover_it(monkeypatch):
    """The weights make up for a correlation of 0.3; a larger one needs blocks."""
    assert coverage(0.6) >= 0.88
    monkeypatch.setattr(intervals, "block_length", lambda n: 1)
    resampling_weights.cache_clear()
    degrees_of_freedom.cache_clear()
    assert coverage(0.6) < 0.85
    resampling_weights.cache_clear()
    degrees_of_freedom.cache_clear()


def test_length_of_blocks():
    assert [block_length(n) for n in (1, 2, 3, 6, 12, 25, 100)] == [1, 1, 2, 2, 3, 5, 10]


def test_two_views_by_hand():
    # Means of two draws are 0, 1 and 2, in half of the cases 1. The variance of (a + b) / 2 is
    # (1 + c) / 2 for values of variance 1 and correlation c, that of the draws (1 - c) / 4.
    found = resampled_means({"a": 0.0, "b": 2.0}, "s")
    wider = (2 * (1 + CORRELATION) / (1 - CORRELATION)) ** 0.5
    assert np.unique(found.round(12)) == pytest.approx([1 - wider, 1, 1 + wider], rel=0.05)
    assert degrees_of_freedom(2) == pytest.approx(1)
    low, high = interval(found, 1)
    t = 12.7062047 / 1.9599640
    assert high - low == pytest.approx(2 * wider * t, rel=0.02)


@pytest.mark.parametrize("n", [2, 3, 6, 9, 40])
def test_correlated_views_have_the_variance_of_their_mean(n):
    weights = resampling_weights(n, 0)
    assert weights.sum(axis=1) == pytest.approx(1)
    lags = np.arange(1, n)
    wanted = (n + 2 * ((n - lags) * CORRELATION**lags).sum()) / n**2
    alike = CORRELATION ** np.abs(np.subtract.outer(np.arange(n), np.arange(n)))
    assert (np.cov(weights.T) * alike).sum() == pytest.approx(wanted)


def test_degrees_of_freedom():
    # Blocks of one view: those of a sample variance. The sum over equal periods adds them up.
    assert 1.5 < degrees_of_freedom(3) <= 2 and 10 < degrees_of_freedom(100) < 15
    assert pooled_freedom([9, 9, 9]) == pytest.approx(3 * degrees_of_freedom(9))
    assert np.isnan(degrees_of_freedom(1)) and np.isnan(pooled_freedom([]))
    assert degrees_of_freedom(4) < pooled_freedom([4, 100]) < degrees_of_freedom(4) * 1.2
    assert pooled_freedom([6, 6], [9, 1]) == pytest.approx(82**2 / 6562 * degrees_of_freedom(6))
    mixed = [5, 7, 9, 3, 11]  # the last digit does not depend on the order
    assert len({pooled_freedom(order) for order in permutations(mixed)}) == 1


def test_neighbours_are_drawn_together_around_the_circle():
    shared = np.cov(resampling_weights(16, 0).T)
    for i in range(16):
        assert shared[i, (i + 1) % 16] > 0 > shared[i, (i + 8) % 16]


def test_the_path_is_the_natural_order_of_the_names():
    def spread(names):
        values = {name: float(i >= 8) for i, name in enumerate(names)}
        return np.std(resampled_means(dict(sorted(values.items())), "s"))

    padded = spread([f"t{i:02}" for i in range(12)])
    assert spread([f"t{i}" for i in range(12)]) == pytest.approx(padded, rel=0.05)


def test_equal_views_are_drawn_alike():
    values = {f"{i}": float(i) for i in range(9)}
    moved = {name: value + 5 for name, value in values.items()}
    one = resampled_means(values, "plaza/0")
    np.testing.assert_allclose(resampled_means(moved, "plaza/0") - one, 5)
    assert not np.allclose(resampled_means(values, "plaza/1"), one)


@pytest.mark.parametrize("values", [[20.0], [20.0, np.inf]])
def test_nothing_is_said_of_a_single_or_an_infinite_value(values):
    found = resampled_means({f"{i}": value for i, value in enumerate(values)}, "s")
    assert np.isnan(found).all() and np.isnan(interval(found, 1)).all()
