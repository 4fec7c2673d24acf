"""The table of camera models; projection through every kind of them, and back."""

import cv2
import numpy as np
import pytest

from chronoscene.io.pycolmap import pycolmap
from chronoscene.scene.cameras import (
    CAMERA_MODELS,
    MODEL_NAMES,
    Camera,
    from_pycolmap,
    project_points,
    to_pycolmap,
    unproject_pixels,
)

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
    """In the frame of a camera, in view of it. [n, 3]"""
    rng = np.random.default_rng(3)
    depth = rng.uniform(1, 20, count)
    plane = [rng.uniform(-0.6, 0.6, count), rng.uniform(-0.5, 0.5, count), np.ones(count)]
    return np.stack(plane, axis=1) * depth[:, None]


def test_the_table_is_that_of_colmap():
    ids = pycolmap.CameraModelId.__members__
    known = {int(model): name for name, model in ids.items() if int(model) >= 0}
    assert dict(enumerate(MODEL_NAMES)) == known
    for name, model in CAMERA_MODELS.items():
        theirs = pycolmap.Camera.create_from_model_id(1, ids[name], 100.0, 64, 48)
        assert len(model.params) == len(theirs.params)
        assert model.num_focals == len(theirs.focal_length_idxs())
        named = theirs.params_info.replace(",", " ").split()
        single = name in ("SIMPLE_RADIAL", "SIMPLE_RADIAL_FISHEYE")  # k there, as k1 of the others
        assert list(model.params) == (["f", "cx", "cy", "k1"] if single else named)


@pytest.mark.parametrize("name", [n for n, m in CAMERA_MODELS.items() if m.two_focals])
def test_the_model_with_two_focal_lengths_is_the_same(name):
    model = CAMERA_MODELS[name]
    params = (50.0, 30.0, 25.0, *(0.01,) * len(model.distortion))
    two = (50.0, *params)
    two += (0.0,) * (len(CAMERA_MODELS[model.two_focals].params) - len(two))
    theirs = [
        to_pycolmap(Camera(1, *c))
        for c in ((name, 64, 48, params), (model.two_focals, 64, 48, two))
    ]
    ray = np.array([0.3, -0.2, 1.0])
    np.testing.assert_allclose(*(c.img_from_cam(ray) for c in theirs), rtol=1e-12)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_to_pycolmap_and_back(camera):
    assert from_pycolmap(to_pycolmap(camera)) == camera


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_as_colmap_does(camera):
    expected = to_pycolmap(camera).img_from_cam(points())
    for local in (points(), np.asfortranarray(points())):
        np.testing.assert_allclose(project_points(camera, local), expected, atol=1e-9)


def test_as_opencv_does():
    camera = CAMERAS[4]
    expected, _ = cv2.projectPoints(
        points(), np.zeros(3), np.zeros(3), camera.K, np.array(camera.distortion)
    )
    np.testing.assert_allclose(project_points(camera, points()), expected[:, 0], atol=1e-9)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_and_back(camera):
    local = points()
    plane = unproject_pixels(camera, project_points(camera, local))
    np.testing.assert_allclose(plane, local[:, :2] / local[:, 2:], atol=1e-7)


@pytest.mark.parametrize("camera", CAMERAS, ids=lambda c: c.model)
def test_nothing_is_seen_behind_a_camera(camera):
    local = np.array([[0, 0, -1.0], [0.1, 0, -2], [0.1, 0.2, 0], [np.nan, 0, 1], [0.1, 0, 1]])
    pixels = project_points(camera, local)
    assert np.isnan(pixels[:3]).all() and np.isnan(pixels[3]).any()
    assert np.isfinite(pixels[4]).all()
    assert project_points(camera, np.zeros((0, 3))).shape == (0, 2)
