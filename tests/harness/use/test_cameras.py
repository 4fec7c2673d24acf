"""Cameras to render from: of the scene, of COLMAP, of nerfstudio, around it; and their periods."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from chronoscene.colmap.model import write_model
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats.shared.transforms import opengl_from_pose
from chronoscene.harness.use.cameras import NORMALISED, OrbitShape, find_viewpoints, with_periods
from chronoscene.harness.use.trained_run import open_run
from chronoscene.harness.view.paths import KeyView, path_file
from chronoscene.scene import Camera, Points
from chronoscene.scene.geometry import camera_centre


@pytest.fixture
def run(trained):
    return open_run(trained["chronogs"])


@pytest.fixture
def one_each(trained):
    return open_run(trained["4dgs"])


def viewpoints_of(run, source, frames=5):
    return find_viewpoints(str(source), run, None, frames)


@pytest.mark.parametrize(("source", "count"), [("test", 3), ("all", 8)])
def test_cameras_of_the_scene_show_their_own_period(run, source, count):
    frames = {f"{f.name}.png": f for f in run.scene().frames}
    viewpoints = with_periods(viewpoints_of(run, source), run, (), 5)
    assert len(viewpoints) == count
    for viewpoint in viewpoints:
        frame = frames[viewpoint.name]
        assert viewpoint.period == frame.period and viewpoint.camera.size == frame.camera.size
        np.testing.assert_array_equal(viewpoint.cam_from_world, frame.cam_from_world)


def test_an_orbit_is_in_the_world_and_has_as_many_pictures_as_asked_for(run):
    viewpoints = viewpoints_of(run, "orbit", 7)
    assert (
        viewpoints.is_path
        and [viewpoint.name for viewpoint in viewpoints.viewpoints][-1] == "0006.png"
    )
    poses = np.stack([viewpoint.cam_from_world for viewpoint in viewpoints.viewpoints])
    cameras = camera_centre(run.scene().frame_poses)
    assert np.abs(camera_centre(poses)).max() < 1.5 * np.abs(cameras).max()


def test_an_orbit_of_another_size_keeps_the_horizontal_field_of_view(run):
    shape = OrbitShape(size=(48, 10), radius=3.0, height=2.0)
    camera = find_viewpoints("orbit", run, None, 1, shape).viewpoints[0].camera
    usual = viewpoints_of(run, "orbit", 1).viewpoints[0].camera
    assert camera.size == (48, 10)
    assert camera.K[0, 0] / 48 == pytest.approx(usual.K[0, 0] / usual.width)


def test_a_model_of_colmap_without_distortion_and_at_most_as_wide_as_the_run(run, tmp_path):
    frames = run.scene().frames[:2]
    wide = Camera(1, "SIMPLE_RADIAL", 4000, 3000, (3000.0, 2000.0, 1500.0, 0.05))
    write_model(tmp_path, [replace(f, camera=wide) for f in frames], Points.empty())
    viewpoints = viewpoints_of(run, tmp_path).viewpoints
    assert [viewpoint.name for viewpoint in viewpoints] == ["a/0.png.png", "a/1.png.png"]
    for viewpoint, frame in zip(viewpoints, frames, strict=True):
        assert viewpoint.camera.is_pinhole and viewpoint.camera.width == run.record.max_width
        np.testing.assert_allclose(viewpoint.cam_from_world, frame.cam_from_world, atol=1e-12)
    with pytest.raises(ConfigError, match="--period: expected a period, or a range"):
        with_periods(viewpoints_of(run, tmp_path), run, (), 5)


def test_a_model_of_colmap_without_images(run, tmp_path):
    for name, line in (("cameras", "1 PINHOLE 4 3 3 3 2 1.5"), ("images", ""), ("points3D", "")):
        (tmp_path / f"{name}.txt").write_text(f"{line}\n")
    with pytest.raises(ConfigError, match="expected a model with images, found none"):
        viewpoints_of(run, tmp_path)


def camera_path(run, **changes):
    """A path of nerfstudio through three poses of the scene, all numbers of a matrix in a row."""
    cameras = [
        {"camera_to_world": opengl_from_pose(f.cam_from_world).ravel().tolist(), "fov": 60}
        for f in run.scene().frames[:3]
    ]
    return {"render_height": 30, "render_width": 40, "camera_path": cameras} | changes


def test_a_camera_path_of_nerfstudio(run, tmp_path):
    path = tmp_path / "path.json"
    path.write_text(json.dumps(camera_path(run)))
    viewpoints = viewpoints_of(run, path)
    assert viewpoints.is_path
    focal = 15 / math.tan(math.radians(30))  # of the height
    for viewpoint, frame in zip(viewpoints.viewpoints, run.scene().frames, strict=False):
        np.testing.assert_allclose(viewpoint.cam_from_world, frame.cam_from_world, atol=1e-12)
        assert viewpoint.camera.size == (40, 30)
        np.testing.assert_allclose(viewpoint.camera.K, [[focal, 0, 20], [0, focal, 15], [0, 0, 1]])
    periods = [s.period for s in with_periods(viewpoints, run, (0.0, 1.0), 99)]
    assert periods == [0.0, 0.5, 1.0]


def test_times_of_a_camera_path_are_periods(run, tmp_path):
    document = camera_path(run)
    for camera, time in zip(document["camera_path"], (0, 0.25, 1), strict=True):
        camera["render_time"] = time
    (tmp_path / "path.json").write_text(json.dumps(document))
    viewpoints = with_periods(viewpoints_of(run, tmp_path / "path.json"), run, (), 5)
    assert [viewpoint.period for viewpoint in viewpoints] == [0, 0.25, 1]


def test_whole_periods_of_a_camera_path_stay_whole(run, tmp_path):
    labels = {str(i): str(i) for i in range(23)}
    many = replace(run, record=run.record.model_copy(update={"period_labels": labels}))
    views = [KeyView(run.scene().frames[0].cam_from_world, 1.0, i) for i in range(23)]
    data = path_file(views, 23 / 24, (4, 3), 23, whole=True)
    (tmp_path / "path.json").write_bytes(data)
    viewpoints = viewpoints_of(many, tmp_path / "path.json").viewpoints
    assert [viewpoint.period for viewpoint in viewpoints] == [*range(23)]


def test_the_frame_of_a_model_of_nerfstudio_is_undone(run, tmp_path):
    """That frame is scale (transform x), for positions x in the world."""
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    shift, scale = np.array([1.0, 2.0, 3.0]), 0.25
    frame = run.scene().frames[1]
    moved = opengl_from_pose(frame.cam_from_world)
    moved[:3, 3] = scale * (turn @ moved[:3, 3] + shift)
    moved[:3, :3] = turn @ moved[:3, :3]
    document = camera_path(run, camera_path=[{"camera_to_world": moved.ravel().tolist(), "fov": 5}])
    (tmp_path / "path.json").write_text(json.dumps(document))
    transform = np.hstack([turn, shift[:, None]]).tolist()
    (tmp_path / NORMALISED).write_text(json.dumps({"transform": transform, "scale": scale}))
    (viewpoint,) = viewpoints_of(run, tmp_path / "path.json").viewpoints
    np.testing.assert_allclose(viewpoint.cam_from_world, frame.cam_from_world, atol=1e-12)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"camera_type": "equirectangular"}, "expected perspective cameras"),
        ({"camera_path": []}, "expected a list of cameras"),
        ({"render_height": 0.5}, "expected render_height in whole pixels"),
        ({"camera_path": [{"fov": 60}]}, r"camera_path\[0\]: expected a matrix"),
        (
            {"camera_path": [{"fov": 180, "camera_to_world": np.eye(4).tolist()}]},
            "a fov between 0 and 180",
        ),
    ],
)
def test_a_camera_path_that_is_none(run, tmp_path, changes, message):
    (tmp_path / "path.json").write_text(json.dumps(camera_path(run, **changes)))
    with pytest.raises(SceneError, match=message):
        viewpoints_of(run, tmp_path / "path.json")


def test_a_scene_without_test_views(run, monkeypatch):
    scene = run.scene()
    frames = [replace(frame, split="train") for frame in scene.frames]
    monkeypatch.setattr(type(run), "scene", lambda self, root: scene.with_frames(frames))
    assert len(viewpoints_of(run, "all").viewpoints) == 8
    with pytest.raises(ConfigError, match="--cameras test: expected a scene with test views"):
        viewpoints_of(run, "test")


def test_a_source_that_is_none(run):
    with pytest.raises(ConfigError, match="--cameras tent: expected test, all, orbit, the folder"):
        viewpoints_of(run, "tent")


def test_each_camera_that_stands_shows_the_whole_range(run):
    viewpoints = with_periods(viewpoints_of(run, "test"), run, (1.0, 0.0), 3)
    assert [viewpoint.period for viewpoint in viewpoints] == [1.0, 0.5, 0.0] * 3
    names = [viewpoint.name for viewpoint in viewpoints]
    assert names[:2] == ["a/2.png/0000.png", "a/2.png/0001.png"] and len(set(names)) == 9


@pytest.mark.parametrize(("ends", "expected"), [((0, 1), [0, 0, 1, 1]), ((1, 0), [1, 1, 0, 0])])
def test_a_range_of_whole_periods_gives_each_an_equal_share(one_each, ends, expected):
    viewpoints = with_periods(viewpoints_of(one_each, "orbit", 4), one_each, ends, 99)
    assert [viewpoint.period for viewpoint in viewpoints] == expected


def test_too_few_pictures_of_whole_periods_show_the_first_and_the_last(one_each):
    viewpoints = viewpoints_of(one_each, "orbit", 2)
    ends = (0.0, 5.0)
    assert [v.period for v in with_periods(viewpoints, one_each, ends, 99)] == [0, 5]
