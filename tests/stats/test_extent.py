"""How far a scene reaches."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.stats.extent import robust_range


@pytest.mark.parametrize("share", [0.0, 0.02, 0.06, 0.15])
def test_an_even_spread_is_inside_as_a_whole_and_strays_are_not(share: float) -> None:
    rng = np.random.default_rng(0)
    place = rng.uniform([-50, -15, -3], [50, 15, 3], (20_000, 3))
    far = rng.random(len(place)) < share
    xyz = np.where(far[:, None], place * rng.uniform(5, 400, (len(place), 1)), place)
    low, high = robust_range(xyz)
    assert ((place >= low - 0.1) & (place <= high + 0.1)).all()
    assert (high - low <= 1.2 * np.ptp(place, axis=0) + 2).all()


def test_towers_of_a_flat_place_are_no_strays() -> None:
    rng = np.random.default_rng(0)
    xyz = rng.uniform([0, 0, 0], [100, 100, 0.2], (10_000, 3))
    xyz[:500, 2] = rng.uniform(0, 40, 500)
    assert robust_range(xyz)[1, 2] > 20


@given(
    st.lists(st.tuples(*[st.floats(-1e6, 1e6)] * 3), min_size=1, max_size=40),
    st.sampled_from([1e-6, 1.0, 1e3]),
)
def test_limits_are_in_order_and_within_the_cloud(places: list, scale: float) -> None:
    xyz = scale * np.array(places)
    low, high = robust_range(xyz)
    assert (low <= high).all()
    assert (low >= xyz.min(axis=0)).all() and (high <= xyz.max(axis=0)).all()


def test_a_choice_of_many_points_gives_the_same() -> None:
    xyz = np.random.default_rng(0).normal(size=(400_000, 3))
    np.testing.assert_allclose(robust_range(xyz), robust_range(xyz[:90_000]), atol=0.05)
