"""Projection through every camera model of COLMAP, and back."""

import cv2
import numpy as np
import pytest

from chronoscene.colmap.model import to_pycolmap
from chronoscene.scene import Camera
from chronoscene.scene.projection import pixels_of, plane_of

CAMERAS = [
    Camera(1, "SIMPLE_PINHOLE", 800, 600, (500.0, 410.0, 290.0)),
    Camera(1, "PINHOLE", 800, 600, (500.0, 480.0, 410.0, 290.0)),
    Camera(1, "SIMPLE_RADIAL", 800, 600, (500.0, 410.0, 290.0, -0.1)),
    Camera(1, "RADIAL", 800, 600, (500.0, 410.0, 290.0, -0.1, 0.02)),
    Camera(1, "OPENCV", 800, 600, (500.0, 480.0, 410.0, 290.0, -0.1, 0.02, 1e-3, -2e-3)),
    Camera(1, "OPENCV_FISHEYE", 800, 600, (500.0, 480.0, 410.0, 290.0, 0.01, 0.02, 0.0, 0.0)),
    Camera(1, "FOV", 800, 600, (500.0, 480.0, 410.0, 290.0, 0.4)),
]


def points(count: int = 200) -> np.ndarray:
    """In the frame of a camera, in view of it. [3, n]"""
    rng = np.random.default_rng(3)
    depth = rng.uniform(1, 20, count)
    return (
        np.stack([rng.uniform(-0.6, 0.6, count), rng.uniform(-0.5, 0.5, count), 1 + 0 * depth])
        * depth
    )


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_as_colmap_does(camera):
    x, y, z = points()
    expected = to_pycolmap(camera).img_from_cam(np.stack([x, y, z], axis=1))
    np.testing.assert_allclose(np.stack(pixels_of(camera, x, y, z), axis=1), expected, atol=1e-9)


def test_as_opencv_does():
    camera = CAMERAS[4]
    local = points()
    expected, _ = cv2.projectPoints(
        local.T.copy(), np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion)
    )
    found = np.stack(pixels_of(camera, *local), axis=1)
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_and_back(camera):
    x, y, z = points()
    plane = plane_of(camera, np.stack(pixels_of(camera, x, y, z), axis=1))
    np.testing.assert_allclose(plane, np.stack([x / z, y / z], axis=1), atol=1e-7)


@pytest.mark.parametrize("camera", CAMERAS[2:], ids=lambda c: c.model)
def test_what_distortion_cannot_place_is_not_a_number(camera):
    at = pixels_of(camera, np.array([0, 0, np.nan, 0.1]), np.zeros(4), np.array([-1.0, 0, 1, 1]))
    assert np.isnan(at[0][:3]).all() and np.isfinite(at[0][3])
