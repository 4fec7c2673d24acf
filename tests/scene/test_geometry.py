"""Quaternions, poses and similarities: properties, over many orders of magnitude."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from chronoscene.scene.geometry import (
    Sim3,
    camera_centre,
    pose_from_rotation_translation,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

unit = st.floats(-1, 1, allow_subnormal=False)
quaternions = arrays(float, 4, elements=unit).filter(lambda q: np.linalg.norm(q) > 1e-3)
rotations = quaternions.map(rotation_from_quaternion)
points = arrays(float, (5, 3), elements=st.floats(-1e7, 1e7, allow_subnormal=False))
vectors = arrays(float, 3, elements=st.floats(-1e7, 1e7, allow_subnormal=False))
"""Coordinates up to the size of a projected reference system, in metres."""
sims = st.builds(Sim3, st.floats(1e-4, 1e4), rotations, vectors)


def magnitude(*arrays_: np.ndarray) -> float:
    """Largest number involved: the unit of the rounding errors."""
    return max(1.0, *(float(np.abs(a).max(initial=0)) for a in arrays_))


@given(quaternions)
def test_rotations_are_proper(q):
    rotation = rotation_from_quaternion(q)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-14)
    assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-14)


@given(quaternions)
def test_quaternion_round_trip(q):
    back = quaternion_from_rotation(rotation_from_quaternion(q))
    unit_q = q / np.linalg.norm(q)
    assert back[0] >= 0
    assert np.linalg.norm(back) == pytest.approx(1, abs=1e-14)
    assert abs(back @ unit_q) == pytest.approx(1, abs=1e-14)


@pytest.mark.parametrize("axis", np.eye(3))
def test_half_turns_do_not_divide_by_zero(axis):
    rotation = 2 * np.outer(axis, axis) - np.eye(3)
    np.testing.assert_allclose(quaternion_from_rotation(rotation), [0, *axis], atol=1e-15)


def test_rotation_follows_the_wxyz_convention():
    quarter_turn_about_z = [np.sqrt(0.5), 0, 0, np.sqrt(0.5)]
    rotated = rotation_from_quaternion(quarter_turn_about_z) @ [1, 0, 0]
    np.testing.assert_allclose(rotated, [0, 1, 0], atol=1e-15)


@given(arrays(float, (2, 3, 4), elements=unit))
def test_batches_equal_single_calls(batch):
    assume((np.linalg.norm(batch, axis=-1) > 1e-3).all())
    together = rotation_from_quaternion(batch)
    for i in np.ndindex(2, 3):
        np.testing.assert_array_equal(together[i], rotation_from_quaternion(batch[i]))


@given(rotations, vectors)
def test_camera_centre_maps_to_the_origin(rotation, translation):
    pose = pose_from_rotation_translation(rotation, translation)
    centre = camera_centre(pose)
    np.testing.assert_allclose(
        pose[:3, :3] @ centre + pose[:3, 3], 0, atol=1e-14 * magnitude(translation)
    )
    np.testing.assert_array_equal(camera_centre(np.stack([pose, pose])), [centre, centre])


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
