"""Blocks of a split; `test_split_making` has the strategies on scenes."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.scene.split_strategies import choose_blocks, cut_into_blocks


@given(
    st.integers(1, 60).flatmap(
        lambda n: st.tuples(
            st.lists(st.tuples(*[st.floats(-100, 100)] * 3), min_size=n, max_size=n),
            st.integers(1, n),
        )
    )
)
def test_blocks_have_equally_many_cameras(case):
    places, count = np.array(case[0]), case[1]
    sizes = np.bincount(cut_into_blocks(places, count), minlength=count)
    assert len(sizes) == count and sizes.sum() == len(places)
    assert sizes.min() >= 1
    assert sizes.max() <= 2 * len(places) / count + 2


@given(
    st.lists(st.tuples(st.integers(0, 5), st.integers(0, 2)), min_size=3, max_size=40),
    st.integers(1, 5),
    st.integers(0, 99),
)
def test_every_period_keeps_training_images(pairs, wanted, seed):
    used = sorted({b for b, _ in pairs})
    block = np.array([used.index(b) for b, _ in pairs])
    periods = np.array([p for _, p in pairs])
    chosen = choose_blocks(block, periods, wanted, seed)
    is_test = np.isin(block, list(chosen))
    assert set(periods[~is_test]) == set(periods)
