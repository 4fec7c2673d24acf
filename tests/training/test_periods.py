"""Weights of the periods' features."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.errors import ConfigError
from chronoscene.training.periods import period_weights


@given(st.integers(1, 50), st.data())
def test_integers_are_one_hot(num_periods: int, data: st.DataObject) -> None:
    period = data.draw(st.integers(0, num_periods - 1))
    np.testing.assert_array_equal(
        period_weights(period, num_periods), np.eye(num_periods, dtype=np.float32)[period]
    )


@given(st.integers(2, 50), st.floats(0.0, 1.0))
def test_fractions_mix_the_two_neighbours(num_periods: int, share: float) -> None:
    period = share * (num_periods - 1)
    weights = period_weights(period, num_periods)
    assert weights.sum() == pytest.approx(1.0, abs=1e-6)
    assert weights.min() >= 0.0
    assert weights @ np.arange(num_periods) == pytest.approx(period, abs=1e-4)
    outside = [i for i in range(num_periods) if abs(i - period) > 1.0]
    assert not weights[outside].any()


def test_a_quarter() -> None:
    np.testing.assert_array_equal(period_weights(1.25, 4), [0.0, 0.75, 0.25, 0.0])


@pytest.mark.parametrize("period", [-0.5, 2.5, 3, math.nan, math.inf])
def test_other_periods_are_refused(period: float) -> None:
    with pytest.raises(ConfigError, match=r"period: expected a number within 0\.\.2"):
        period_weights(period, 3)
