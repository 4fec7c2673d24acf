"""Orbits keep to where the cameras are, with the right way up."""

import numpy as np
import pytest

from chronoscene.scene.geometry import camera_centre, look_at
from chronoscene.scene.orbit import find_up, orbit

UP = np.array([0.2, 0.3, 0.9]) / np.linalg.norm([0.2, 0.3, 0.9])
EAST = np.cross(UP, [1.0, 0.0, 0.0]) / np.linalg.norm(np.cross(UP, [1.0, 0.0, 0.0]))
NORTH = np.cross(UP, EAST)
MIDDLE = np.array([5.0, -2.0, 1.0])
POINTS = MIDDLE + np.random.default_rng(0).normal(size=(500, 3)) * 0.1


def ring(angles, height=4.0):
    """Cameras 10 from the middle, at angles from east, that look at it."""
    eyes = [MIDDLE + 10 * (np.cos(a) * EAST + np.sin(a) * NORTH) + height * UP for a in angles]
    return np.stack([look_at(eye, MIDDLE, up=UP) for eye in eyes])


def places(poses):
    """Angle, distance and height of cameras about the middle."""
    offsets = camera_centre(poses) - MIDDLE
    east, north = offsets @ EAST, offsets @ NORTH
    return np.arctan2(north, east), np.hypot(east, north), offsets @ UP


def test_cameras_on_all_sides_give_a_circle_from_the_first_one_on():
    angles, distances, heights = places(orbit(ring(np.linspace(0.4, 6.4, 20)), POINTS, 8))
    np.testing.assert_allclose(distances, 10, atol=0.1)
    np.testing.assert_allclose(heights, 4, atol=0.1)
    np.testing.assert_allclose(np.unwrap(angles), 0.4 + 2 * np.pi * np.arange(8) / 8, atol=0.03)


def test_a_radius_and_a_height_of_ones_own():
    poses = orbit(ring(np.linspace(0.4, 6.4, 20)), POINTS, 8, radius=3.0, height=-2.0)
    _, distances, heights = places(poses)
    np.testing.assert_allclose(distances, 3, atol=0.1)
    np.testing.assert_allclose(heights, -2, atol=0.1)


def test_cameras_on_one_side_give_a_swing_over_that_side():
    angles, _, _ = places(orbit(ring(np.linspace(-0.5, 0.9, 20)), POINTS, 40))
    assert angles[0] == pytest.approx(-0.5, abs=0.02)
    assert angles.min() > -0.52 and angles.max() == pytest.approx(0.9, abs=0.02)


def test_the_middle_is_in_the_middle_of_each_picture_and_up_is_up():
    for pose in orbit(ring(np.linspace(0, 6, 20)), POINTS, 5):
        local = pose[:3, :3] @ MIDDLE + pose[:3, 3]
        assert local[2] > 0 and np.abs(local[:2]).max() < 0.02 * local[2]
        assert (pose[:3, :3] @ UP)[1] < -0.5 and abs((pose[:3, :3] @ UP)[0]) < 0.02


@pytest.mark.parametrize("height", [0.0, 3.0, 30.0])
def test_up_is_found_whatever_the_cameras_look_at(height):
    assert find_up(ring(np.linspace(0, 6, 9), height)) @ UP > 0.9999
    assert find_up(ring([0.2, 0.9], height)) @ UP > 0.999


@pytest.mark.parametrize("headings", [(0,), (0, np.pi), (0, np.pi / 2)])
def test_up_is_up_where_cameras_look_straight_down(headings):
    """Flights over the ground, each with one heading."""
    poses = []
    for i, j in np.ndindex(5, 4):
        eye = MIDDLE + (i - 2) * EAST + 2 * (j - 1.5) * NORTH + 10 * UP
        turn = headings[i % len(headings)] + 0.02 * (j - i)
        poses.append(look_at(eye, eye - UP, roll=turn, up=NORTH))
    assert find_up(np.stack(poses)) @ UP > 0.999


def test_one_camera_right_above():
    down = look_at(MIDDLE + 10 * UP, MIDDLE, up=NORTH)[None]
    assert np.isfinite(orbit(down, MIDDLE[None], 4)).all()


def test_points_that_are_not_finite_do_not_count():
    poses, lost = ring(np.linspace(0.4, 6.4, 20)), [[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0]]
    found = orbit(poses, np.concatenate([lost, POINTS]), 4)
    np.testing.assert_array_equal(found, orbit(poses, POINTS, 4))
