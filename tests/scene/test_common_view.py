"""What cameras have in view; `tests/stats/test_view_overlap.py` has more, by whole scenes."""

import numpy as np

from chronoscene.scene import Camera
from chronoscene.scene.common_view import common_view

CAMERA = Camera(1, "PINHOLE", 100, 100, (50.0, 50.0, 50.0, 50.0))


def test_shares_by_owner_and_viewer():
    xyz = np.array([[0, 0, 10], [9, 0, 10], [0, 0, -10], [0, 0, 50], [100, 0, 10.0]])
    owner = np.array([0, 0, 1, 1, 1])
    aside = np.eye(4)
    aside[0, 3] = -100
    views = [[(CAMERA, np.eye(4))], [(CAMERA, np.eye(4)), (CAMERA, aside)], []]
    share = common_view(xyz, owner, views, np.array([20.0, 60.0, np.nan]))
    nan = np.nan
    np.testing.assert_allclose(share, [[1, 1, nan], [0, 2 / 3, nan], [nan, nan, nan]])


def test_lenses_that_turn_back_do_not_map_points_into_the_image():
    lens = Camera(2, "SIMPLE_RADIAL", 100, 100, (50.0, 50.0, 50.0, -0.3))
    xyz = np.array([[0.1, 0, 1], [1.8, 0, 1.0]])  # the polynomial sends the second to (52.5, 50)
    share = common_view(xyz, np.array([0, 1]), [[(lens, np.eye(4))]] * 2, np.array([9.0, 9.0]))
    np.testing.assert_array_equal(share, [[1, 1], [0, 0]])
