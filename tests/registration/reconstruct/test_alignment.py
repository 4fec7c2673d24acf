"""Similarities between models and to GPS, against known ones."""

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
from chronoscene.registration.reconstruct.gps_alignment import align_to_gps, upright_direction
from chronoscene.scene.geometry import camera_centre, pose_from_rotation_translation
from chronoscene.scene.similarity import Sim3

Array = NDArray[np.float64]

TRUTH = Sim3(
    2.5, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), np.array([5.0, 1.0, -3.0])
)


def looking_at(centre: Array, target: Array, up: tuple[float, float, float] = (0, 0, 1)) -> Array:
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return pose_from_rotation_translation(rotation, -rotation @ centre)


def make_pairs(rng: np.random.Generator, points: Array, moved: Array) -> PointPairs:
    """Points seen by cameras above them in both models; ``moved`` is where the source has them."""
    inverse = TRUTH.inverse()
    rows = len(points)
    poses = [
        looking_at(
            np.array([*rng.uniform(-30, 30, 2), 40.0]), np.array([*rng.uniform(-5, 5, 2), 0])
        )
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


def circle(count: int, radius: float = 20.0) -> Array:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack(
        [
            looking_at(np.array([radius * np.cos(a), radius * np.sin(a), 8.0]), np.zeros(3))
            for a in angles
        ]
    )


def test_gps_with_gross_outliers() -> None:
    rng = np.random.default_rng(6)
    world = circle(30)
    model = TRUTH.inverse().apply_to_pose(world)
    enu = camera_centre(world) + rng.normal(0, 0.3, (30, 3))
    wrong = [3, 11, 25]
    enu[wrong] += rng.uniform(50, 300, (3, 3))
    enu[7] = np.nan
    found = align_to_gps(model, enu, np.ones(30, bool))
    assert found is not None
    assert found.is_useful
    assert not found.inliers[[*wrong, 7]].any()
    assert found.inliers.sum() >= 24
    np.testing.assert_allclose(
        found.enu_from_model.apply(camera_centre(model)), camera_centre(world), atol=0.5
    )
    assert np.isnan(found.residuals[7])
    assert found.rms == pytest.approx(0.3 * np.sqrt(3), rel=0.3)


def test_gps_noise_as_large_as_the_scene_is_of_no_use() -> None:
    rng = np.random.default_rng(7)
    world = circle(12, radius=2.0)
    enu = camera_centre(world) + rng.normal(0, 3.0, (12, 3))
    found = align_to_gps(world, enu, np.ones(12, bool))
    assert found is not None
    assert not found.is_useful


def test_a_straight_walk_stands_upright_by_its_horizon() -> None:
    rng = np.random.default_rng(8)
    world = np.stack(
        [
            looking_at(
                np.array([2.0 * i, 0.0, 1.6]), np.array([2.0 * i + 5, rng.normal(0, 2), 1.6])
            )
            for i in range(20)
        ]
    )
    model = TRUTH.inverse().apply_to_pose(world)
    enu = camera_centre(world) + rng.normal(0, 0.2, (20, 3))
    found = align_to_gps(model, enu, np.ones(20, bool))
    assert found is not None
    assert found.on_a_line
    aligned = found.enu_from_model.apply_to_pose(model)
    assert upright_direction(aligned)[2] > 0.999


def test_fewer_than_three_positions_say_nothing() -> None:
    world = circle(5)
    enu = np.full((5, 3), np.nan)
    enu[:2] = camera_centre(world)[:2]
    assert align_to_gps(world, enu, np.ones(5, bool)) is None


def test_up_of_photos_that_look_straight_down() -> None:
    rng = np.random.default_rng(9)
    poses = np.stack(
        [
            looking_at(
                np.array([*rng.uniform(-9, 9, 2), 50.0]),
                np.array([0.0, 0.0, 0.0]),
                up=(rng.normal(), rng.normal(), 0.0),
            )
            for _ in range(10)
        ]
    )
    assert upright_direction(poses)[2] > 0.9
