"""Intervals: coverage on paths whose mean is known, closed forms, what is drawn alike."""

import numpy as np
import pytest
from made_runs import smooth
from scipy.stats import ttest_ind_from_stats

from chronoscene.harness.report import intervals
from chronoscene.harness.report.intervals import (
    block_length,
    interval,
    resampled_means,
    resampling_weights,
    seed_margin,
)


def coverage(correlation, periods=3, views=40, paths=200):
    """Share of paths whose interval holds the true mean, 0."""
    found = 0
    rng = np.random.default_rng(0)
    for i, path in enumerate(smooth(rng, (paths, periods, views), correlation)):
        means = [
            resampled_means({f"{k}.png": value for k, value in enumerate(values)}, f"{i}/{period}")
            for period, values in enumerate(path)
        ]
        low, high = interval(np.mean(means, axis=0))
        found += low <= 0 <= high
    return found / paths


@pytest.mark.parametrize("correlation", [0.0, 0.3])
def test_the_interval_covers_the_mean(correlation):
    assert 0.88 <= coverage(correlation) <= 0.99


def test_single_views_would_not_cover_it(monkeypatch):
    monkeypatch.setattr(intervals, "block_length", lambda n: 1)
    resampling_weights.cache_clear()
    assert coverage(0.3) < 0.88
    resampling_weights.cache_clear()


def test_length_of_blocks():
    assert [block_length(n) for n in (1, 2, 3, 6, 12, 25, 100)] == [1, 1, 2, 2, 3, 5, 10]


def test_two_views_by_hand():
    # Means of two draws are 0, 1 and 2; their distance to 1 times sqrt(2), by n / (n - 1).
    found = np.unique(resampled_means({"a": 0.0, "b": 2.0}, "s").round(12))
    assert found == pytest.approx([1 - 2**0.5, 1, 1 + 2**0.5])
    low, high = interval(resampled_means({"a": 0.0, "b": 2.0}, "s"))
    assert (low, high) == pytest.approx((1 - 2**0.5, 1 + 2**0.5))


@pytest.mark.parametrize("n", [2, 3, 6, 9, 40])
def test_independent_views_have_the_variance_of_a_mean(n):
    # Of values with variance 1 the weighted means have the variance sum_j var(w_j), here 1 / n.
    weights = resampling_weights(n, 0)
    assert weights.sum(axis=1) == pytest.approx(1)
    assert weights.var(axis=0).sum() == pytest.approx(1 / n, rel=0.05)


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
    assert np.isnan(found).all() and np.isnan(interval(found)).all()


def test_the_margin_of_seeds_is_that_of_welch():
    margins = seed_margin([0.5, 2.0, np.nan], [3, 5, 1], 0.25, 4)
    for margin, sd, n in zip(margins[:2], (0.5, 2.0), (3, 5), strict=True):
        test = ttest_ind_from_stats(20 + margin, sd, n, 20, 0.25, 4, equal_var=False)
        assert test.pvalue == pytest.approx(0.05)
    assert np.isnan(margins[2])
