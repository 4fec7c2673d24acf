"""Views are drawn without replacement, in an order that depends on the seed alone."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.training.sampler import ViewSampler


@given(st.integers(1, 40), st.integers(0, 2**32), st.integers(1, 4))
def test_every_pool_holds_every_view_once(count, seed, pools):
    sampler = ViewSampler(count, seed)
    for _ in range(pools):
        assert sorted(sampler.next() for _ in range(count)) == list(range(count))


@given(st.integers(1, 20), st.integers(0, 100), st.integers(0, 60))
def test_a_resumed_sampler_continues_the_order(count, seed, done):
    whole = ViewSampler(count, seed)
    expected = [whole.next() for _ in range(done + 15)][done:]
    resumed = ViewSampler(count, seed)
    resumed.drawn = done
    assert [resumed.next() for _ in range(15)] == expected


def test_the_order_depends_on_the_seed_and_changes_between_pools():
    orders = []
    for seed in (0, 1):
        sampler = ViewSampler(50, seed)
        orders += [[sampler.next() for _ in range(50)] for _ in range(2)]
    assert len({tuple(order) for order in orders}) == 4


def test_no_views_is_an_error():
    with pytest.raises(ValueError, match="at least 1"):
        ViewSampler(0, 0)
