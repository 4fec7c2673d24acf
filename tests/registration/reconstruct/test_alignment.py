"""Similarities between models, against known ones."""

import numpy as np
import pytest
from numpy.typing import NDArray

from chronoscene.registration.reconstruct.alignment import (
    PointPairs,
    align_by_points,
    cell_members,
    cell_weights,
    cells,
    residual_pixels,
)
from chronoscene.scene.geometry import look_at
from chronoscene.scene.similarity import Sim3

Array = NDArray[np.float64]

TRUTH = Sim3(
    2.5, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 1.0, -3.0])
)


def make_pairs(rng: np.random.Generator, points: Array, moved: Array) -> PointPairs:
    """Points seen by cameras above them in both models; ``moved`` is where the source has them."""
    inverse = TRUTH.inverse()
    rows = len(points)
    poses = [
        look_at(np.array([*rng.uniform(-30, 30, 2), 40.0]), np.array([*rng.uniform(-5, 5, 2), 0]))
        for _ in range(rows)
    ]
    target_pose = np.stack(poses)
    source_pose = np.stack([inverse.apply_to_pose(pose) for pose in poses])

    def rays(pose: Array, xyz: Array) -> Array:
        local = np.einsum("nij,nj->ni", pose[:, :3, :3], xyz) + pose[:, :3, 3]
        return local[:, :2] / local[:, 2:]

    source = inverse.apply(moved)
    return PointPairs(
        source=source,
        target=points,
        source_pose=source_pose,
        target_pose=target_pose,
        source_ray=rays(source_pose, source) + rng.normal(0, 0.5 / 800, (rows, 2)),
        target_ray=rays(target_pose, points) + rng.normal(0, 0.5 / 800, (rows, 2)),
        source_focal=np.full(rows, 800.0),
        target_focal=np.full(rows, 800.0),
    )


def assert_near_truth(found: Sim3, *, scale: float = 2e-3) -> None:
    assert found.scale == pytest.approx(TRUTH.scale, rel=scale)
    corners = TRUTH.inverse().apply(np.array([[-30.0, -30, 0], [30, -30, 0], [30, 30, 5]]))
    np.testing.assert_allclose(found.apply(corners), TRUTH.apply(corners), atol=0.15)


def test_sixty_percent_wrong_matches_are_no_matter() -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -30, 0], [30, 30, 8], (500, 3))
    moved = points.copy()
    wrong = rng.random(500) < 0.6
    moved[wrong] = rng.permutation(moved[wrong])
    found = align_by_points(make_pairs(rng, points, moved))
    assert found is not None
    assert found.is_trustworthy
    assert_near_truth(found.target_from_source)
    assert found.inliers[~wrong].mean() > 0.95
    assert found.inliers[wrong].mean() < 0.1


def test_a_moved_heap_with_most_of_the_matches_does_not_win() -> None:
    rng = np.random.default_rng(1)
    stable = rng.uniform([-30, -30, 0], [30, 30, 8], (200, 3))
    heap = rng.uniform([5, 5, 0], [9, 9, 3], (600, 3))
    points = np.concatenate([stable, heap])
    moved = points.copy()
    moved[200:] += [3.0, -2.0, 1.0]
    found = align_by_points(make_pairs(rng, points, moved))
    assert found is not None
    assert_near_truth(found.target_from_source)
    assert found.inliers[:200].mean() > 0.95
    assert found.inliers[200:].mean() < 0.05


def test_random_matches_are_not_trusted() -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform([-30, -30, 0], [30, 30, 8], (150, 3))
    found = align_by_points(make_pairs(rng, points, rng.permutation(points)))
    assert found is None or not found.is_trustworthy


def test_too_few_pairs_give_nothing() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-30, 30, (2, 3))
    assert align_by_points(make_pairs(rng, points, points)) is None


def test_residuals_are_infinite_behind_a_camera() -> None:
    rng = np.random.default_rng(4)
    points = rng.uniform([-30, -30, 0], [30, 30, 8], (5, 3))
    pairs = make_pairs(rng, points, points)
    assert residual_pixels(TRUTH, pairs).max() < 3.0
    behind = Sim3(TRUTH.scale, TRUTH.rotation, TRUTH.translation + np.array([0, 0, 100.0]))
    assert np.isinf(residual_pixels(behind, pairs)).all()


def test_cells_give_places_equal_say() -> None:
    rng = np.random.default_rng(5)
    wide = rng.uniform([-10, -10, 0], [10, 10, 1], (100, 3))
    heap = rng.uniform([4, 4, 0], [4.2, 4.2, 0.1], (900, 3))
    cell = cells(np.concatenate([wide, heap]))
    weights = cell_weights(cell)
    assert weights[100:].sum() < 0.6 * weights[:100].sum()
    members = cell_members(cell)
    assert sorted(np.concatenate(members).tolist()) == list(range(1000))
    assert all(len(set(cell[m].tolist())) == 1 for m in members)
