"""The scene in memory: intrinsics of every camera model, selections, periods of points."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chronoscene.formats import read_scene
from chronoscene.scene import Camera, Frame, Period, Points, Scene
from chronoscene.scene.cameras import to_pycolmap

MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL": 5,
    "RADIAL_FISHEYE": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
    "FULL_OPENCV": 12,
    "FOV": 5,
    "THIN_PRISM_FISHEYE": 12,
    "RAD_TAN_THIN_PRISM_FISHEYE": 16,
    "SIMPLE_DIVISION": 4,
    "DIVISION": 5,
    "SIMPLE_FISHEYE": 3,
    "FISHEYE": 4,
    "EUCM": 6,
}


@pytest.mark.parametrize("model", MODELS)
def test_intrinsics_agree_with_colmap(model):
    params = tuple(float(10 * (i + 1)) for i in range(MODELS[model]))
    camera = Camera(1, model, 64, 48, params)
    theirs = to_pycolmap(camera)
    np.testing.assert_array_equal(camera.K, theirs.calibration_matrix())
    used = len(theirs.focal_length_idxs()) + len(theirs.principal_point_idxs())
    assert camera.distortion == params[used:]
    assert camera.is_pinhole == (not camera.distortion and "FISHEYE" not in model)


@pytest.mark.parametrize("model", MODELS)
def test_what_is_a_pinhole_projects_as_one(model):
    """COLMAP's projection of a camera with zero distortion is that of the calibration matrix."""
    focals = 1 if model in ("RADIAL", "RADIAL_FISHEYE") or model.startswith("SIMPLE_") else 2
    zeros = (0.0,) * (MODELS[model] - focals - 2)
    camera = Camera(1, model, 64, 48, (*(50.0, 52.0)[:focals], 30.0, 25.0, *zeros))
    ray = np.array([0.3, -0.2, 1.0])
    if camera.is_pinhole:
        pixel = to_pycolmap(camera).img_from_cam(ray)
        np.testing.assert_allclose(pixel, (camera.K @ ray)[:2], rtol=1e-14)
    perspective = "PINHOLE" in model or model.endswith(("RADIAL", "OPENCV"))
    assert camera.is_pinhole == perspective


@pytest.mark.parametrize("value", [1e-300, -1e-9, float("nan")])
@pytest.mark.parametrize("model", ["SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"])
def test_any_distortion_at_all_is_no_pinhole(model, value):
    params = (50.0,) * (MODELS[model] - 1)
    zero = Camera(1, model, 64, 48, (*params, 0.0))
    zeros = (0.0,) * len(zero.distortion)
    kept = zero.params[: -len(zeros)]
    assert replace(zero, params=kept + zeros).is_pinhole
    for i in range(len(zeros)):
        bent = (*zeros[:i], value, *zeros[i + 1 :])
        assert not replace(zero, params=kept + bent).is_pinhole


def tiny_scene() -> Scene:
    """Two periods of two images; points seen by both periods, by one, by none."""
    camera = Camera(1, "PINHOLE", 8, 8, (8.0, 8.0, 4.0, 4.0))
    frames = tuple(
        Frame(f"{i}.png", i + 1, camera, np.eye(4), i // 2, "test" if i % 2 else "train")
        for i in range(4)
    )
    points = Points(
        ids=np.array([1, 2, 3]),
        xyz=np.zeros((3, 3)),
        rgb=np.zeros((3, 3), np.uint8),
        error=np.zeros(3),
        track_start=np.array([0, 3, 4, 4]),
        track_frame=np.array([0, 1, 2, 3], np.int32),
        track_xy=np.zeros((4, 2)),
    )
    periods = (Period(0, "0"), Period(1, "1"))
    return Scene("tiny", Path("r"), Path("r/images"), frames, points, periods, "rule", "test")


def test_periods_of_points():
    scene = tiny_scene()
    expected = [[True, True], [False, True], [False, False]]
    np.testing.assert_array_equal(scene.point_periods(), expected)
    empty = replace(scene, points=Points.empty())
    assert empty.point_periods().shape == (0, 2)


@pytest.mark.parametrize(
    ("keep", "starts", "frames"),
    [
        ([1, 1, 1], [0, 3, 4, 4], [0, 1, 2, 3]),
        ([0, 1, 1], [0, 1, 1], [3]),
        ([1, 0, 1], [0, 3, 3], [0, 1, 2]),
        ([0, 0, 1], [0, 0], []),
        ([0, 0, 0], [0], []),
    ],
)
def test_some_of_the_points(keep, starts, frames):
    points = replace(
        tiny_scene().points,
        xyz=np.arange(9.0).reshape(3, 3),
        rgb=np.arange(9, dtype=np.uint8).reshape(3, 3),
        error=np.arange(3.0),
        track_xy=np.arange(8.0).reshape(4, 2),
    )
    mask = np.array(keep, bool)
    some = points.select(mask)
    assert len(some) == mask.sum()
    assert some.track_start.tolist() == starts and some.track_frame.tolist() == frames
    assert some.track_xy.tolist() == points.track_xy[frames].tolist()  # frame i is seen in row i
    for name in ("ids", "xyz", "rgb", "error"):
        np.testing.assert_array_equal(getattr(some, name), getattr(points, name)[mask])
    for name in Points.__dataclass_fields__:
        assert getattr(some, name).dtype == getattr(points, name).dtype


def test_points_that_are_still_observed_and_those_that_never_were():
    points = tiny_scene().points
    rank = np.arange(8, dtype=np.int32)
    keep = np.arange(len(points.track_frame)) < 3
    assert points.select_observed(keep, rank).ids.tolist() == points.ids[:1].tolist()
    assert len(points.select_observed(keep & False, rank)) == 0
    scanned = points.select_observations(keep & False, rank)
    assert scanned.select_observed(keep[:0], rank) is scanned


def test_select():
    scene = tiny_scene()
    assert [f.name for f in scene.select()] == ["0.png", "1.png", "2.png", "3.png"]
    assert [f.name for f in scene.select(split="test")] == ["1.png", "3.png"]
    assert [f.name for f in scene.select(split="train", period=1)] == ["2.png"]
    assert scene.image_path(scene.frames[2]) == Path("r/images/2.png")
    assert scene.num_periods == 2


def test_with_frames_refuses_other_frames():
    scene = tiny_scene()
    swapped = [replace(f, period=1 - f.period) for f in scene.frames]
    assert [f.period for f in scene.with_frames(swapped).frames] == [1, 1, 0, 0]
    with pytest.raises(AssertionError):
        scene.with_frames(scene.frames[::-1])


def test_point_periods_of_a_file_agree_with_its_tracks(make_scene_folder):
    scene = read_scene(make_scene_folder())
    seen = scene.point_periods()
    for i in range(len(scene.points)):
        start, end = scene.points.track_start[i : i + 2]
        periods = {scene.frames[j].period for j in scene.points.track_frame[start:end]}
        assert set(np.flatnonzero(seen[i])) == periods
