"""Who sees a point, reprojection, and where rays meet, against what loops say; common view.

`tests/statistics/test_measures_in_view.py` has more of common view, by whole scenes.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.scene import Camera
from chronoscene.scene.geometry import pose_from_rotation_translation
from chronoscene.scene.tracks import (
    MIN_PARALLAX,
    by_image,
    common_view,
    count_views,
    intersect_rays,
    reproject,
    seen_by_period,
    select_tracks,
    track_owners,
)

CAMERA = Camera(1, "PINHOLE", 100, 100, (50.0, 50.0, 50.0, 50.0))
START = np.array([0, 2, 2, 5])
IMAGE = np.array([1, 0, 2, 0, 1])


def test_owners_and_selection() -> None:
    assert track_owners(START).tolist() == [0, 0, 2, 2, 2]
    start, observed = select_tracks(START, np.array([False, True, True]))
    assert start.tolist() == [0, 0, 3]
    assert observed.tolist() == [False, False, True, True, True]


def test_views_are_counted_by_point_and_period() -> None:
    period = np.array([0, 0, 1])[IMAGE]
    counts = count_views(track_owners(START), period, (3, 2))
    assert counts.tolist() == [[2, 0], [0, 0], [2, 1]]
    seen = seen_by_period(track_owners(START), period, (3, 2))
    np.testing.assert_array_equal(seen, counts > 0)
    assert count_views(np.zeros(0, np.int64), np.zeros(0, np.int64), (0, 2)).shape == (0, 2)


@given(st.lists(st.integers(0, 4), max_size=30))
def test_observations_of_each_image_in_order(image: list[int]) -> None:
    rows = by_image(np.array(image, np.int32), 5)
    assert [r.tolist() for r in rows] == [
        [k for k, i in enumerate(image) if i == number] for number in range(5)
    ]
    assert by_image(np.zeros(0, np.int32), 0) == []


def test_reprojection_has_error_and_depth_in_front_only() -> None:
    camera = Camera(1, "PINHOLE", 200, 100, (100.0, 100.0, 100.0, 50.0))
    views = [
        (camera, np.eye(4)),
        (camera, pose_from_rotation_translation(np.diag([-1.0, 1.0, -1.0]), np.zeros(3))),
    ]
    (front, error, depth), (back, *behind) = reproject(
        views,
        np.array([[1.0, 0.0, 4.0]]),
        np.array([0, 2]),
        np.array([0, 1]),
        np.array([[122.0, 54.0], [0.0, 0.0]]),
    )
    assert (front, back) == ([0], [1])
    np.testing.assert_allclose(error, [5.0])  # from (125, 50)
    assert depth == [4.0]
    assert np.isnan(behind).all()


def test_rays_meet_and_parallax_is_the_sine_of_half_their_angle() -> None:
    target = np.array([1.0, 2.0, 30.0])
    centre = np.array([[0.0, 0, 0], [3, 0, 0], [0, 0, 0], [0, 1e-3, 0]])
    direction = target - centre
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    xyz, parallax = intersect_rays(direction, centre, np.array([0, 2]))
    np.testing.assert_allclose(xyz[0], target)
    half = np.arccos(direction[0] @ direction[1]) / 2
    assert parallax[0] == pytest.approx(np.sin(half) ** 2)
    assert parallax[0] > MIN_PARALLAX > parallax[1]


def test_shares_by_owner_and_viewer() -> None:
    xyz = np.array([[0, 0, 10], [9, 0, 10], [0, 0, -10], [0, 0, 50], [100, 0, 10.0]])
    owner = np.array([0, 0, 1, 1, 1])
    aside = np.eye(4)
    aside[0, 3] = -100
    views = [[(CAMERA, np.eye(4))], [(CAMERA, np.eye(4)), (CAMERA, aside)], []]
    share = common_view(xyz, owner, views, np.array([20.0, 60.0, np.nan]))
    nan = np.nan
    np.testing.assert_allclose(share, [[1, 1, nan], [0, 2 / 3, nan], [nan, nan, nan]])


def test_lenses_that_turn_back_do_not_map_points_into_the_image() -> None:
    lens = Camera(2, "SIMPLE_RADIAL", 100, 100, (50.0, 50.0, 50.0, -0.3))
    xyz = np.array([[0.1, 0, 1], [1.8, 0, 1.0]])  # the polynomial sends the second to (52.5, 50)
    share = common_view(xyz, np.array([0, 1]), [[(lens, np.eye(4))]] * 2, np.array([9.0, 9.0]))
    np.testing.assert_array_equal(share, [[1, 1], [0, 0]])
