"""The cubic filter: exact where it must be, and what it does beyond the border."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.images.undistortion import warp, warp_mask


def places(*values):
    return np.array([values], np.float32)


@given(st.integers(0, 99), st.integers(-3, 3), st.integers(-3, 3))
def test_whole_pixels_only_move(seed, dx, dy):
    image = np.random.default_rng(seed).integers(0, 256, (12, 15, 3), np.uint8)
    y, x = np.mgrid[4:8, 4:11].astype(np.float32) + 0.5
    np.testing.assert_array_equal(
        warp(image, x + dx, y + dy), image[4 + dy : 8 + dy, 4 + dx : 11 + dx]
    )


@given(st.floats(3, 27), st.floats(3, 27))
def test_parabolas_are_reproduced(x, y):
    """Up to the rounding to whole grey levels, before and after."""
    v, u = np.mgrid[:30, :30] + 0.5
    image = np.round(40 + 0.15 * u * u + 3 * v).astype(np.uint8)[..., None]
    value = warp(image, places(x), places(y))[0, 0, 0]
    assert abs(float(value) - (40 + 0.15 * x * x + 3 * y)) <= 1.3


def test_beyond_the_border_the_border_is_repeated():
    image = np.array([[[10], [200]]], np.uint8)
    assert warp(image, places(-50, -3.0, 60), places(0.5, 90, -9)).ravel().tolist() == [10, 10, 200]


def test_places_that_are_nowhere_are_black():
    image = np.full((4, 4, 3), 9, np.uint8)
    assert warp(image, places(np.nan, np.inf, 2), places(1, 1, np.nan)).max() == 0


def test_overshoot_is_cut_off():
    image = np.repeat(np.array([[0, 0, 255, 255]], np.uint8)[..., None], 4, 0)
    line = warp(
        image, np.linspace(0.5, 3.5, 31, dtype=np.float32)[None], np.full((1, 31), 2, np.float32)
    )
    assert line.min() == 0 and line.max() == 255
    assert (np.diff(line[0, 10:21, 0].astype(int)) >= 0).all()


def test_a_mask_lets_count_what_nothing_ignored_reaches():
    rng = np.random.default_rng(0)
    mask = rng.random((40, 50)) > 0.02
    images = rng.integers(0, 256, (2, 40, 50, 3), np.uint8)
    images[1][mask] = images[0][mask]
    v, u = np.mgrid[:40, :50]
    x = (1.06 * u - 0.11 * v + 1.3).astype(np.float32)
    y = (0.93 * v + 0.08 * u - 0.4).astype(np.float32)
    x[3, 4], y[5, 6] = np.nan, np.inf
    new, warped = warp_mask(mask, x, y), [warp(image, x, y) for image in images]
    np.testing.assert_array_equal(warped[0][new], warped[1][new])
    assert not new[3, 4] and not new[5, 6] and new.mean() > 0.6
    assert warp_mask(np.ones((40, 50), bool), x, y).sum() == 40 * 50 - 2
