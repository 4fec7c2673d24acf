"""Quaternions, poses: properties, over many orders of magnitude."""

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from chronoscene.scene.geometry import (
    camera_centre,
    pose_from_rotation_translation,
    quaternion_from_rotation,
    rotation_from_quaternion,
)

unit = st.floats(-1, 1, allow_subnormal=False)
quaternions = arrays(float, 4, elements=unit).filter(lambda q: np.linalg.norm(q) > 1e-3)
rotations = quaternions.map(rotation_from_quaternion)
vectors = arrays(float, 3, elements=st.floats(-1e7, 1e7, allow_subnormal=False))
"""Coordinates up to the size of a projected reference system, in metres."""


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
