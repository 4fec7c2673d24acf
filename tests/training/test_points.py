"""Sparse points that models start from."""

import numpy as np
import pytest

from chronoscene.errors import SceneError
from chronoscene.training.points import finite_rows, rms_spacing


def test_points_that_are_not_finite_are_dropped_and_none_is_refused() -> None:
    points = np.array([[0.0, 1.0, 2.0], [np.nan, 0, 0], [np.inf, 0, 0]])
    np.testing.assert_array_equal(finite_rows(points), [True, False, False])
    with pytest.raises(SceneError, match="sparse points: expected at least one point"):
        finite_rows(points[1:])


def test_spacing_is_the_root_mean_square_of_three() -> None:
    points = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0], [4, 0, 0]])
    expected = np.sqrt([(1 + 4 + 16) / 3, (1 + 1 + 9) / 3, (1 + 4 + 4) / 3, (4 + 9 + 16) / 3])
    np.testing.assert_allclose(rms_spacing(points), expected)
    np.testing.assert_array_equal(rms_spacing(points, 1), [1, 1, 1, 2])


def test_a_lone_point_has_no_spacing() -> None:
    assert rms_spacing(np.zeros((1, 3), np.float32)).tolist() == [0.0]
