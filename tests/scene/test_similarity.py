"""Similarities: properties over many orders of magnitude, and fits with outliers."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from chronoscene.scene.geometry import (
    camera_centre,
    pose_from_rotation_translation,
    rotation_from_quaternion,
)
from chronoscene.scene.similarity import (
    AT_ONCE,
    Sim3,
    fit,
    fit_few,
    fit_robustly,
    fit_samples,
    scale_deviation,
)

unit = st.floats(-1, 1, allow_subnormal=False)
rotations = (
    arrays(float, 4, elements=unit)
    .filter(lambda q: np.linalg.norm(q) > 1e-3)
    .map(rotation_from_quaternion)
)
large = st.floats(-1e7, 1e7, allow_subnormal=False)
"""Coordinates up to the size of a projected reference system, in metres."""
points = arrays(float, (5, 3), elements=large)
vectors = arrays(float, 3, elements=large)
sims = st.builds(Sim3, st.floats(1e-4, 1e4), rotations, vectors)


def magnitude(*arrays_: np.ndarray) -> float:
    """Largest number involved: the unit of the rounding errors."""
    return max(1.0, *(float(np.abs(a).max(initial=0)) for a in arrays_))


@given(sims, points)
def test_similarity_inverse(sim, x):
    there = sim.apply(x)
    tolerance = 1e-14 * magnitude(there, sim.translation) / sim.scale
    np.testing.assert_allclose(sim.inverse().apply(there), x, atol=tolerance + 1e-14 * magnitude(x))


@given(sims, points)
def test_similarity_equals_its_matrix(sim, x):
    matrix = sim.to_matrix()
    by_matrix = x @ matrix[:3, :3].T + matrix[:3, 3]
    size = magnitude(sim.scale * x, sim.translation)
    np.testing.assert_allclose(sim.apply(x), by_matrix, atol=1e-14 * size)
    back = Sim3.from_matrix(matrix)
    assert back.scale == pytest.approx(sim.scale, rel=1e-13)
    np.testing.assert_allclose(back.rotation, sim.rotation, atol=1e-13)


@given(sims, rotations, vectors, points)
def test_moving_world_and_camera_together_scales_what_the_camera_sees(sim, rotation, t, x):
    pose = pose_from_rotation_translation(rotation, t)
    moved = sim.apply_to_pose(pose)
    seen = x @ rotation.T + t
    seen_moved = sim.apply(x) @ moved[:3, :3].T + moved[:3, 3]
    size = magnitude(sim.apply(x), moved[:3, 3], sim.translation, sim.scale * seen)
    np.testing.assert_allclose(seen_moved, sim.scale * seen, atol=1e-13 * size)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-13)


@given(sims, rotations, vectors)
def test_the_camera_centre_moves_like_a_point(sim, rotation, t):
    pose = pose_from_rotation_translation(rotation, t)
    moved = camera_centre(sim.apply_to_pose(pose))
    expected = sim.apply(camera_centre(pose))
    size = magnitude(expected, sim.translation, sim.scale * t)
    np.testing.assert_allclose(moved, expected, atol=1e-13 * size)


def test_identity_changes_nothing():
    x = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(Sim3.identity().apply(x), x)


@given(sims, sims, points)
def test_a_product_applies_the_right_one_first(second, first, x):
    expected = second.apply(first.apply(x))
    size = second.scale * magnitude(first.apply(x), first.scale * x, first.translation)
    size = magnitude(expected, second.translation, np.array(size))
    np.testing.assert_allclose((second @ first).apply(x), expected, atol=1e-13 * size)


def test_similarity_of_few_points():
    rng = np.random.default_rng(0)
    move = Sim3(2.0, np.eye(3)[[1, 2, 0]], np.array([1.0, 2.0, 3.0]))
    source = rng.normal(size=(6, 3))
    target = move.apply(source)
    target[2] += 3.0
    found = fit_few(source, target)
    assert found is not None
    np.testing.assert_allclose(found[0].to_matrix(), move.to_matrix(), atol=1e-6)
    assert found[1].tolist() == [True, True, False, True, True, True]
    line = np.outer(np.arange(5.0), [1.0, 2.0, 3.0])
    assert fit_few(line, line) is None
    assert fit_few(source[:2], target[:2]) is None


def test_robust_fit_with_outliers():
    rng = np.random.default_rng(0)
    truth = Sim3(
        3.0,
        Rotation.from_euler("xyz", [20, 30, 40], degrees=True).as_matrix(),
        np.array([5.0, 6, 7]),
    )
    source = rng.normal(size=(200, 3))
    target = truth.apply(source)
    target[:90] += rng.normal(size=(90, 3)) * 50
    found, distance = fit_robustly(source, target)
    assert found.scale == pytest.approx(3.0, rel=1e-9)
    np.testing.assert_allclose(found.matrix, 3 * truth.rotation, atol=1e-9)
    assert distance[90:].max() < 1e-8


@pytest.mark.parametrize("place", [0, AT_ONCE - 1, AT_ONCE, 2 * AT_ONCE + 3])
def test_the_first_sample_of_least_cost_is_found_wherever_it_is(place):
    source = np.random.default_rng(1).normal(size=(8, 3))
    source[3] = source[2] = source[1]  # these three fix nothing
    target = 2.0 * source
    target[0] += 1.0  # all samples with it are wrong
    samples = np.array([[0, 4, 5]] * (2 * AT_ONCE + 5))
    samples[::2] = [1, 2, 3]
    samples[place:] = [5, 6, 7]
    samples[place + 1 :] = [4, 5, 6]

    def costs(candidates):
        return np.median(np.linalg.norm(candidates.apply(source) - target, axis=-1), axis=1)

    found, cost = fit_samples(source, target, samples, lambda c: costs(c).round(6))
    assert cost == 0
    np.testing.assert_array_equal(found.matrix, fit(source[[5, 6, 7]], target[[5, 6, 7]]).matrix)
    assert fit_samples(source, target, samples[:0], costs) == (None, np.inf)
    assert fit_samples(source, target, np.array([[1, 2, 3]] * 3), costs) == (None, np.inf)


def test_points_on_a_line_fix_nothing():
    line = np.linspace(0, 1, 20)[:, None] * [1.0, 2.0, 3.0]
    assert fit_robustly(line, line) is None


def test_the_scale_is_the_best_one_also_where_a_reflection_would_fit_better():
    source = np.random.default_rng(3).normal(size=(20, 3))
    found = fit(source, 2.0 * source * [1, 1, -1])
    assert np.linalg.det(found.matrix) > 0
    a = (source - source.mean(axis=0)) @ (found.matrix / found.scale).T
    b = 2.0 * (source - source.mean(axis=0)) * [1, 1, -1]
    assert found.scale == pytest.approx((a * b).sum() / (a * a).sum())


def test_few_points_are_judged_by_most_of_the_others():
    """Three points on a line and a wrong one fit exactly if the rest is turned around the line."""
    line, others = [[0, 0, 0], [10, 0, 0], [20, 0, 0]], [[12, 6, 3], [3, -7, 2], [15, 5, -6]]
    source = np.array([*line, [5, 8, 0], *others], float)
    target = source.copy()
    target[3] = [5, 0, 8]
    target[4:] += np.random.default_rng(0).normal(0, 0.02, (3, 3))
    sim, used = fit_few(source, target)
    assert used.tolist() == [True, True, True, False, True, True, True]
    np.testing.assert_allclose(sim.apply(source)[used], target[used], atol=0.1)


def test_along_two_axes_a_wrong_height_is_no_distance():
    rng = np.random.default_rng(4)
    source = rng.uniform(-50, 50, (60, 3))
    target = source + rng.normal(0, 0.01, (60, 3))
    target[0, 2] += 5
    for axes, expected in ((3, 5.0), (2, 0.0)):
        _, distances = fit_robustly(source, target, axes=axes)
        assert distances[0] == pytest.approx(expected, abs=0.3)


def test_the_deviation_of_a_scale_is_that_of_repeated_fits() -> None:
    rng = np.random.default_rng(5)
    target = rng.uniform(-20, 20, (12, 3)) * [1, 1, 0.2]
    scales, stated = [], []
    for _ in range(400):
        noisy = target + rng.normal(0, 1.5, target.shape)
        found = fit(target, noisy)
        assert found is not None
        scales.append(found.scale)
        stated.append(scale_deviation(found.apply(target) - noisy, noisy))
    assert np.median(stated) == pytest.approx(np.std(scales), rel=0.12)
