"""Learning rates over a training."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.training.schedules import cooled, log_linear

POSITIVE = st.floats(1e-8, 1e3)


@given(POSITIVE, POSITIVE)
def test_ends_are_exact_and_the_middle_is_the_geometric_mean(start, end):
    assert log_linear(0.0, start, end) == start
    assert log_linear(1.0, start, end) == end
    assert log_linear(0.5, start, end) == pytest.approx(np.sqrt(start * end), rel=1e-12)


@given(POSITIVE, POSITIVE, st.floats(-1, 2), st.floats(-1, 2))
def test_monotone_and_within_the_ends(start, end, first, second):
    low, high = sorted((start, end))
    values = [log_linear(p, start, end) for p in sorted((first, second))]
    for value in values:
        assert low * (1 - 1e-12) <= value <= high * (1 + 1e-12)
    sign = 1 if end >= start else -1
    assert sign * (values[1] - values[0]) >= -1e-12 * high


def test_the_published_position_rate_half_way():
    # 1.6e-4 -> 1.6e-6: a factor of ten down in the middle.
    assert log_linear(0.5, 1.6e-4, 1.6e-6) == pytest.approx(1.6e-5)


def test_off_stays_off_and_a_zero_end_is_refused():
    assert log_linear(0.3, 0.0, 0.0) == 0.0
    with pytest.raises(ValueError, match="positive"):
        log_linear(0.3, 1.0, 0.0)


def test_a_cooldown_takes_the_last_part_down_to_a_tenth():
    found = [cooled({"means": 2.0}, progress, 0.25)["means"] for progress in (0, 0.75, 0.875, 1)]
    assert found == pytest.approx([2.0, 2.0, 2.0 * 10**-0.5, 0.2])
    assert cooled({"means": 2.0}, 1.0, 0.0) == {"means": 2.0}
