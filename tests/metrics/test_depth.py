"""Closed forms of depth errors."""

import numpy as np
import pytest

from chronoscene.errors import ShapeError
from chronoscene.metrics.depth import depth_errors


def test_errors_of_four_pixels_by_hand():
    truth = np.array([[2.0, 4.0, 0.0], [5.0, 10.0, 0.0]])
    depth = np.array([[2.2, 3.0, 7.0], [5.0, 0.0, 0.0]])
    errors = depth_errors(depth, truth)
    assert errors["depth_abs_rel"] == pytest.approx((0.1 + 0.25 + 0 + 1) / 4)
    assert errors["depth_rmse"] == pytest.approx(np.sqrt((0.04 + 1 + 0 + 100) / 4))
    assert errors["depth_delta"] == 0.5  # 4 / 3 > 1.25, and nothing was rendered in the last


def test_the_ratio_counts_both_ways_and_is_strict():
    truth = np.full((1, 4), 4.0)
    depth = np.array([[5.0, 4.99, 3.2, 3.21]])
    assert depth_errors(depth, truth)["depth_delta"] == 0.5


def test_a_common_factor_is_not_fitted():
    truth = np.random.default_rng(0).uniform(1, 9, (5, 6))
    errors = depth_errors(1.1 * truth, truth)
    assert errors["depth_abs_rel"] == pytest.approx(0.1)
    assert errors["depth_rmse"] == pytest.approx(0.1 * np.sqrt((truth**2).mean()))


def test_the_mask_decides():
    truth, mask = np.full((2, 2), 3.0), np.array([[True, False], [False, False]])
    depth = np.where(mask, 3.0, 9.0)
    expected = {"depth_abs_rel": 0, "depth_rmse": 0, "depth_delta": 1}
    assert depth_errors(depth, truth, mask) == expected
    sky = np.where([[False, True], [False, False]], 0.0, truth)
    assert depth_errors(depth, sky, mask | (sky == 0)) == expected
    with pytest.raises(ShapeError, match="at least one pixel"):
        depth_errors(depth, 0 * truth)
