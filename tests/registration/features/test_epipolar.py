"""Matches that one epipolar geometry allows, on generated pairs of photos."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chronoscene.arrays import Array
from chronoscene.registration.features.epipolar import (
    CERTAIN,
    MANY,
    MIN_INLIERS,
    near_epipolar_lines,
)


def pair(right: int, wrong: int, noise: float = 0.5, seed: int = 0) -> tuple[Array, Array]:
    """Pixels in two photos of 800 x 600: of points in space first, then of false matches."""
    rng = np.random.default_rng(seed)
    points = rng.uniform([-4, -3, 6], [4, 3, 14], (right, 3))
    turn = Rotation.from_euler("xyz", [3, -12, 5], degrees=True).as_matrix()
    photos = []
    for local in (points, points @ turn.T + [2.0, 0.3, 0.5]):
        xy = 600 * local[:, :2] / local[:, 2:] + [400, 300] + rng.normal(0, noise, (right, 2))
        photos.append(np.concatenate([xy, rng.uniform(0, [800, 600], (wrong, 2))]))
    return photos[0], photos[1]


@pytest.mark.parametrize(("right", "wrong"), [(300, 150), (40, 30), (25, 10)])
def test_what_the_geometry_excludes_is_left_out(right: int, wrong: int) -> None:
    kept = near_epipolar_lines(*pair(right, wrong))
    assert kept[:right].all()
    assert kept[right:].mean() < 0.4  # Near some line are few, by chance
    np.testing.assert_array_equal(kept, near_epipolar_lines(*pair(right, wrong)))


def test_points_of_a_plane_are_kept() -> None:
    rng = np.random.default_rng(1)
    a = rng.uniform(0, [800, 600], (120, 2))
    homography = np.array([[0.9, 0.1, 30], [-0.05, 1.1, -20], [1e-4, -5e-5, 1]])
    b = np.column_stack([a, np.ones(120)]) @ homography.T
    b = b[:, :2] / b[:, 2:] + rng.normal(0, 0.5, (120, 2))
    wrong = rng.uniform(0, [800, 600], (2, 60, 2))
    kept = near_epipolar_lines(np.concatenate([a, wrong[0]]), np.concatenate([b, wrong[1]]))
    assert kept[:120].mean() > 0.98


def test_false_matches_alone_are_too_few_to_be_verified() -> None:
    left = [near_epipolar_lines(*pair(0, 30, seed=seed)) for seed in range(20)]
    assert all(kept.all() or kept.sum() < MIN_INLIERS for kept in left)
    assert sum(int(kept.sum() < MIN_INLIERS) for kept in left) > 15


def test_uncertain_matches_are_all_left_to_colmap() -> None:
    assert near_epipolar_lines(*pair(CERTAIN - 4, 12)).all()  # a geometry could be chance
    assert near_epipolar_lines(*pair(MIN_INLIERS - 1, 0)).all()
    assert near_epipolar_lines(*pair(MANY // 3, 4 * MANY)).all()  # samples could have missed one
    assert near_epipolar_lines(np.zeros((0, 2)), np.zeros((0, 2))).shape == (0,)


def test_matches_in_one_place_have_no_geometry() -> None:
    same = np.full((30, 2), 100.0)
    assert near_epipolar_lines(same, same).shape == (30,)
