"""Differences: closed forms of both errors, the choice of the best, what is left out of it."""

import numpy as np
import pytest
from scipy.stats import studentized_range, t, ttest_ind

from chronoscene.harness.report.differences import (
    SeedSpread,
    explained_by_seeds,
    margins,
    seed_spread,
)
from chronoscene.harness.report.intervals import REPLICATES

NO_SEEDS = SeedSpread(np.full(9, np.nan), 0)


def drawn(m, sd=1.0):
    """Resampled means of independent methods."""
    return sd * np.random.default_rng(0).standard_normal((m, REPLICATES))


def test_spreads_are_pooled_unless_a_method_has_a_larger_one():
    spread = seed_spread([0.5, 2.0, np.nan, np.nan], [3, 5, 1, 2])
    pooled = (2 * 0.25 + 4 * 4.0) / 6
    assert spread.variances == pytest.approx([pooled, 4.0, pooled, pooled]) and spread.freedom == 6
    alone = seed_spread([np.nan, np.nan], [1, 1])
    assert np.isnan(alone.variances).all() and alone.freedom == 0
    assert np.isnan(explained_by_seeds(alone, [1, 1])).all()


def test_seeds_alone_are_a_t_test():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(2, 4))
    b = (b - b.mean()) / b.std() * a.std()  # equal variances, so that pooled ones are their own
    spread = seed_spread([a.std(ddof=1), b.std(ddof=1)], [4, 4])
    (margin,) = explained_by_seeds(spread, [4, 4])
    assert ttest_ind(a - a.mean() + margin, b - b.mean()).pvalue == pytest.approx(0.05)
    means, still = np.array([1.0, 0.0]), np.zeros((2, REPLICATES))
    (found,) = margins(means, still, 9, spread, [4, 4], chosen=True)
    assert found == pytest.approx(margin, rel=0.1)


@pytest.mark.parametrize("freedom", [3, 10, 1000])
def test_views_alone_of_two_methods_are_a_t_test(freedom):
    (found,) = margins(np.zeros(2), drawn(2), freedom, NO_SEEDS, [1, 1], chosen=True)
    assert found == pytest.approx(t.ppf(0.975, freedom) * 2**0.5, rel=0.12)  # 2000 draws


def test_the_best_of_many_is_compared_as_in_the_test_of_tukey():
    found = margins(np.zeros(8), drawn(8), 900, NO_SEEDS, [1] * 8, chosen=True)
    assert found == pytest.approx([studentized_range.ppf(0.95, 8, np.inf)] * 7, rel=0.07)
    named = margins(np.zeros(8), drawn(8), 900, NO_SEEDS, [1] * 8, chosen=False)
    assert (named < 0.93 * found).all()


def test_methods_that_are_told_apart_do_not_widen_the_others():
    means = np.array([0.0, -1.0, -100.0, -100.0, -100.0])
    (near, *_) = margins(means, drawn(5), 900, NO_SEEDS, [1] * 5, chosen=True)
    assert near == pytest.approx(1.96 * 2**0.5, rel=0.05)


def test_equal_differences_of_all_views_have_no_margin():
    draws = drawn(1) + np.array([[0.0], [1.0], [1 / 3]])
    found = margins(np.array([1.0, 0.5, 1.0]), draws, 5, NO_SEEDS, [1] * 3, chosen=True)
    assert found == pytest.approx([0, 0], abs=1e-9)
