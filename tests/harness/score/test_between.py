"""The score between two dates: closed forms of switches and blends."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from chronoscene.harness.score.between import BetweenScore, color_distance, squared_distances

IMAGES = arrays(np.uint8, (2, 5, 6, 3), elements=st.integers(0, 127).map(lambda v: 2 * v))
"""Two dates of even values, so that their mean is exact."""


def score(images, mask):
    return BetweenScore.of(squared_distances(images, mask), int(mask.sum()))


@given(IMAGES, arrays(bool, (5, 6)), arrays(bool, (3, 5, 6)))
def test_pixels_that_switch_are_at_no_distance(dates, mask, switched):
    """Whenever each of them does so."""
    first, last = dates
    middle = [np.where(late[..., None], last, first) for late in switched]
    found = score([first, *middle, last], mask)
    if not mask.any():
        assert found is None
    else:
        assert found.distance == 0
        ratio = 0 if (first != last)[mask].any() else math.nan
        assert found.ratio == pytest.approx(ratio, nan_ok=True)


@given(IMAGES)
def test_halfway_blends_are_at_one_half(dates):
    first, last = dates
    first[0, 0], last[0, 0] = 0, 254
    middle = ((first.astype(int) + last) // 2).astype(np.uint8)
    found = score([first, middle, middle, middle, last], np.ones((5, 6), bool))
    assert found.ratio == pytest.approx(0.5)
    assert found.change == pytest.approx(
        np.sqrt(np.mean((first / 255.0 - last / 255.0) ** 2)), rel=1e-12
    )


def test_a_linear_blend_is_at_one_third():
    """A quarter, a half, a quarter of the way from the nearer date."""
    first, last = np.zeros((5, 6, 3), np.uint8), np.full((5, 6, 3), 200, np.uint8)
    middle = [np.full_like(first, value) for value in (50, 100, 150)]
    assert score([first, *middle, last], np.ones((5, 6), bool)).ratio == pytest.approx(1 / 3)


@given(IMAGES, arrays(np.uint8, (5, 6, 3)), arrays(np.uint8, (5, 6, 3)))
def test_what_does_not_change_does_not_count(dates, image, noise):
    mask = np.zeros((5, 6), bool)
    mask[2, 1:4] = True
    other = np.where(mask[..., None], image, noise)
    first, last = dates
    assert score([first, image, last], mask) == score([first, other, last], mask)


def test_distances_are_one_between_black_and_white():
    black, white = np.zeros((1, 2, 3), np.uint8), np.full((1, 2, 3), 255, np.uint8)
    assert np.all(color_distance(black, white) == 1)
    white[..., 1:] = 0
    assert color_distance(black, white) == pytest.approx(1 / np.sqrt(3))
