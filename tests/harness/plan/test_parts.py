"""Strategies give each model what it may see and nothing else, in one training frame."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from chronoscene.errors import ConfigError, SceneError
from chronoscene.harness.files.strategies import STRATEGIES
from chronoscene.harness.plan.parts import (
    check_points,
    effective_strategy,
    make_parts,
    training_frame,
)
from chronoscene.images.store import ImageStore
from chronoscene.methods import load_spec
from chronoscene.scene import Period, Points
from chronoscene.scene.geometry import camera_centre

TRAIN = ["a/0.png", "a/1.png", "a/3.png", "b/0.png", "b/3.png"]


def parts_of(scene, strategy):
    return make_parts(scene, ImageStore(scene), strategy)


def world_points(part):
    """Points of a training set, back in the world."""
    return part.train.training_from_world.inverse().apply(part.train.points.astype(np.float64))


def test_joint_tells_the_period(make_scene):
    scene = make_scene()
    (part,) = parts_of(scene, "joint")
    assert part.name == "all"
    assert [v.name for v in part.train.views] == TRAIN
    assert [v.period for v in part.train.views] == [0, 0, 0, 1, 1]
    assert part.train.num_periods == 2
    assert [f.name for f in part.test] == ["a/2.png", "b/1.png", "b/2.png"]
    assert [part.method_period(f) for f in part.test] == [0.0, 1.0, 1.0]


def test_joint_keeps_points_that_a_training_view_sees(make_scene):
    scene = make_scene()
    (part,) = parts_of(scene, "joint")
    kept = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11]
    np.testing.assert_allclose(world_points(part), scene.points.xyz[kept], atol=1e-6)
    np.testing.assert_array_equal(part.train.colors, scene.points.rgb[kept])
    # Point 9 is seen in period 1 by a test image only, and point 11 so in period 0.
    expected = [(1, 0)] * 4 + [(0, 1)] * 4 + [(1, 1), (1, 0), (0, 1)]
    np.testing.assert_array_equal(part.train.point_periods, np.array(expected, bool))


def test_pooled_hides_the_period(make_scene):
    scene = make_scene()
    (part,) = parts_of(scene, "pooled")
    assert [v.name for v in part.train.views] == TRAIN
    assert {v.period for v in part.train.views} == {0}
    assert part.train.num_periods == 1
    assert part.train.point_periods.shape == (11, 1) and part.train.point_periods.all()
    assert [part.method_period(f) for f in part.test] == [0.0, 0.0, 0.0]


def test_separate_gives_each_model_its_period_alone(make_scene):
    scene = make_scene()
    first, second = parts_of(scene, "separate")
    assert (first.name, second.name) == ("period-0", "period-1")
    assert [v.name for v in first.train.views] == TRAIN[:3]
    assert [v.name for v in second.train.views] == TRAIN[3:]
    np.testing.assert_allclose(world_points(first), scene.points.xyz[[0, 1, 2, 3, 8, 9]], atol=1e-6)
    np.testing.assert_allclose(
        world_points(second), scene.points.xyz[[4, 5, 6, 7, 8, 11]], atol=1e-6
    )
    for part, tests in ((first, ["a/2.png"]), (second, ["b/1.png", "b/2.png"])):
        centres = camera_centre(np.stack([v.cam_from_world for v in part.train.views]))
        radius = np.linalg.norm(centres - centres.mean(axis=0), axis=1).max()
        assert part.train.camera_extent == pytest.approx(1.1 * radius)
        assert part.train.num_periods == 1
        assert {v.period for v in part.train.views} == {0}
        assert [f.name for f in part.test] == tests
        assert {part.method_period(f) for f in part.test} == {0.0}


def test_sequential_gives_one_model_the_periods_in_order(make_scene):
    scene = make_scene()
    first, second = parts_of(scene, "sequential")
    assert (first.name, second.name) == ("period-0", "period-1")
    assert (first.extends, second.extends) == (False, True)
    assert [v.name for v in first.train.views] == TRAIN[:3]
    assert [v.name for v in second.train.views] == TRAIN[3:]
    assert [{v.period for v in part.train.views} for part in (first, second)] == [{0}, {1}]
    assert (first.train.num_periods, second.train.num_periods) == (1, 2)
    np.testing.assert_allclose(world_points(first), scene.points.xyz[[0, 1, 2, 3, 8, 9]], atol=1e-6)
    kept = [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 11]
    np.testing.assert_allclose(world_points(second), scene.points.xyz[kept], atol=1e-6)
    assert first.train.point_periods.shape == (6, 1) and second.train.point_periods.shape == (11, 2)
    assert [f.name for f in first.test] == ["a/2.png"]
    assert [f.name for f in second.test] == ["a/2.png", "b/1.png", "b/2.png"]
    assert [f.name for f in first.ahead] == ["b/1.png", "b/2.png"] and second.ahead == ()
    assert [first.method_period(f) for f in first.ahead] == [0.0, 0.0]
    assert [second.method_period(f) for f in second.test] == [0.0, 1.0, 1.0]


def test_three_periods_in_order(make_scene):
    """The last views of the second period are a period of their own."""
    scene = make_scene(periods=tuple(Period(i, str(i)) for i in range(3)))
    later = [replace(f, period=2) if f.name in ("b/2.png", "b/3.png") else f for f in scene.frames]
    parts = parts_of(scene.with_frames(later), "sequential")
    assert [part.extends for part in parts] == [False, True, True]
    assert [part.train.num_periods for part in parts] == [1, 2, 3]
    assert [{v.period for v in part.train.views} for part in parts] == [{0}, {1}, {2}]
    assert [[f.name for f in part.test] for part in parts] == [
        ["a/2.png"],
        ["a/2.png", "b/1.png"],
        ["a/2.png", "b/1.png", "b/2.png"],
    ]
    assert [[f.name for f in part.ahead] for part in parts] == [["b/1.png"], ["b/2.png"], []]
    last = scene.frames[6]
    assert [part.method_period(replace(last, period=2)) for part in parts] == [0.0, 1.0, 2.0]
    separate = parts_of(scene.with_frames(later), "separate")
    assert [[v.name for v in p.train.views] for p in separate] == [
        TRAIN[:3],
        ["b/0.png"],
        TRAIN[4:],
    ]


def test_sequential_hides_the_period_from_methods_that_take_none(make_scene):
    scene = make_scene()
    _, second = make_parts(scene, ImageStore(scene), "sequential", takes_period=False)
    assert second.train.num_periods == 1 and {v.period for v in second.train.views} == {0}
    assert {second.method_period(f) for f in second.test} == {0.0}


@pytest.mark.parametrize("at_one_place", [False, True])
def test_a_stage_knows_nothing_of_later_periods(make_scene, at_one_place):
    """Cameras, images and points of period 1 are others; the first stage stays as it is."""
    scene = make_scene()
    frames = list(scene.frames)
    if at_one_place:
        for i in range(4):
            pose = frames[i].cam_from_world.copy()
            pose[:3, 3] = -pose[:3, :3] @ [1.0, 2.0, 3.0]
            frames[i] = replace(frames[i], cam_from_world=pose)
    scene = scene.with_frames(frames)
    far = np.eye(4)
    far[:3, 3] = 1000
    later = [replace(f, cam_from_world=far) if f.period == 1 else f for f in scene.frames]
    xyz = scene.points.xyz.copy()
    xyz[[4, 5, 6, 7]] += 100
    other = replace(scene.with_frames(later), points=replace(scene.points, xyz=xyz))
    one, two = (parts_of(s, "sequential")[0].train for s in (scene, other))
    for field in ("points", "colors", "point_periods", "camera_extent", "scene_extent"):
        np.testing.assert_array_equal(getattr(one, field), getattr(two, field))
    frames = [train.training_from_world.to_matrix() for train in (one, two)]
    np.testing.assert_array_equal(*frames)
    for a, b in zip(one.views, two.views, strict=True):
        np.testing.assert_array_equal(a.cam_from_world, b.cam_from_world)


def test_no_model_sees_a_test_image(make_scene):
    scene = make_scene()
    tests = {f.name for f in scene.select(split="test")}
    for strategy in STRATEGIES:
        for part in parts_of(scene, strategy):
            assert not tests & {v.name for v in part.train.views}


def test_images_are_those_of_the_views(make_scene):
    scene = make_scene()
    store = ImageStore(scene)
    frames = {f.name: f for f in scene.frames}
    for part in make_parts(scene, store, "separate"):
        for i, view in enumerate(part.train.views):
            np.testing.assert_array_equal(part.train.load_image(i), store.load(frames[view.name]))
            assert part.train.load_image(i).shape == (view.height, view.width, 3)


def test_every_strategy_but_sequential_uses_one_training_frame(make_scene):
    scene = make_scene()
    frames = [
        part.train.training_from_world.to_matrix()
        for strategy in STRATEGIES
        if strategy != "sequential"
        for part in parts_of(scene, strategy)
    ]
    assert all(np.array_equal(frames[0], other) for other in frames)


def test_training_frame_is_centred_and_scaled(make_scene):
    scene = make_scene()
    (part,) = parts_of(scene, "joint")
    centres = camera_centre(np.stack([v.cam_from_world for v in part.train.views]))
    np.testing.assert_allclose(centres.mean(axis=0), 0, atol=1e-12)
    assert np.linalg.norm(centres, axis=1).max() == pytest.approx(1, abs=1e-12)
    assert part.train.camera_extent == pytest.approx(1.1, abs=1e-12)


def test_training_frame_ignores_test_cameras(make_scene):
    scene = make_scene()
    far = np.eye(4)
    far[:3, 3] = 1000
    moved = [replace(f, cam_from_world=far) if f.split == "test" else f for f in scene.frames]
    expected = training_frame(scene).to_matrix()
    np.testing.assert_array_equal(training_frame(scene.with_frames(moved)).to_matrix(), expected)


def test_projections_do_not_depend_on_the_frame(make_scene):
    scene = make_scene()
    (part,) = parts_of(scene, "joint")
    frames = {f.name: f for f in scene.frames}
    points = scene.points.xyz
    inside = part.train.training_from_world.apply(points)
    for view in part.train.views:
        world_pose = frames[view.name].cam_from_world
        a = (points @ world_pose[:3, :3].T + world_pose[:3, 3]) @ view.K.T
        b = (inside @ view.cam_from_world[:3, :3].T + view.cam_from_world[:3, 3]) @ view.K.T
        np.testing.assert_allclose(a[:, :2] / a[:, 2:], b[:, :2] / b[:, 2:], atol=1e-9)


def test_coordinates_of_a_national_grid_change_nothing(make_scene):
    (near,) = parts_of(make_scene(), "joint")
    (far,) = parts_of(make_scene(shift=5e6), "joint")
    np.testing.assert_allclose(far.train.points, near.train.points, atol=1e-7)
    for a, b in zip(near.train.views, far.train.views, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-7)


def test_test_views_are_in_the_same_frame_and_size(make_scene):
    scene = make_scene()
    store = ImageStore(scene, max_width=12)
    (part,) = make_parts(scene, store, "joint")
    view = part.view(part.test[0])
    assert (view.width, view.height) == (12, 8)
    expected = part.train.training_from_world.apply_to_pose(part.test[0].cam_from_world)
    np.testing.assert_array_equal(view.cam_from_world, expected)
    np.testing.assert_allclose(view.K[:2], part.test[0].camera.K[:2] / 2)


def test_a_period_with_one_training_camera_keeps_the_extent_of_the_scene(make_scene):
    scene = make_scene()
    frames = [replace(f, split="test") if f.name == "b/0.png" else f for f in scene.frames]
    _, second = parts_of(scene.with_frames(frames), "separate")
    assert len(second.train.views) == 1
    assert second.train.camera_extent == pytest.approx(1.1)


@pytest.mark.parametrize("apart", [0.0, 0.02])
def test_cameras_close_together_are_scaled_by_what_they_see(make_scene, apart):
    scene = make_scene()
    frames = []
    for i, frame in enumerate(scene.frames):
        pose = np.eye(4)
        pose[:3, 3] = apart * i, 0.0, 10.0  # all look along z at the points, which are around 0
        frames.append(replace(frame, cam_from_world=pose))
    scene = scene.with_frames(frames)
    (part,) = parts_of(scene, "joint")
    train, depth = part.train, np.median(world_points(part)[:, 2]) + 10
    assert train.training_from_world.scale == pytest.approx(1 / (0.5 * depth))
    assert train.scene_extent == pytest.approx(1.1)
    if apart:
        centres = np.array([camera_centre(f.cam_from_world) for f in scene.select(split="train")])
        radius = np.linalg.norm(centres - centres.mean(0), axis=1).max()
        assert train.camera_extent == pytest.approx(1.1 * radius / (0.5 * depth))


def test_the_extent_of_cameras_around_a_scene_is_that_of_the_scene(make_scene):
    for part in parts_of(make_scene(), "separate"):
        assert part.train.scene_extent == part.train.camera_extent


def test_distorted_cameras_are_refused(make_scene):
    scene = make_scene()
    camera = replace(
        scene.frames[0].camera, model="OPENCV", params=(20.0, 20.0, 12.0, 8.0) + (0.1,) * 4
    )
    bent = scene.with_frames([replace(scene.frames[0], camera=camera), *scene.frames[1:]])
    bent = replace(bent, root=Path("a b"))
    with pytest.raises(
        SceneError, match=r"a/0\.png: expected .* found OPENCV; run chronoscene undistort 'a b' OUT"
    ):
        parts_of(bent, "joint")


def test_a_scene_without_training_images_is_refused(make_scene):
    scene = make_scene()
    todo = f"(chronoscene split {scene.root} --scene-out NEW"
    found = f"at least one train image, found none .*{re.escape(todo)}"
    with pytest.raises(SceneError, match=found):
        parts_of(scene.with_frames([replace(f, split="test") for f in scene.frames]), "joint")


def test_a_period_without_training_images_stops_separate_only(make_scene):
    scene = make_scene()
    frames = [replace(f, split="test") if f.period == 1 else f for f in scene.frames]
    scene = scene.with_frames(frames)
    assert len(parts_of(scene, "joint")[0].train.views) == 3
    with pytest.raises(SceneError, match="period 1: expected at least one training image"):
        parts_of(scene, "separate")


def test_a_scene_without_points_is_refused(make_scene):
    with pytest.raises(SceneError, match="expected sparse points that a training image sees"):
        parts_of(make_scene(points=Points.empty()), "joint")


def test_points_without_any_track_are_taken_for_all_periods(make_scene):
    scene = make_scene()
    count = len(scene.points)
    points = replace(
        scene.points,
        track_start=np.zeros(count + 1, np.int64),
        track_frame=np.zeros(0, np.int32),
        track_xy=np.zeros((0, 2)),
    )
    (part,) = parts_of(replace(scene, points=points), "joint")
    assert part.train.point_periods.shape == (count, scene.num_periods)
    assert part.train.point_periods.all()


def test_methods_without_period_run_pooled_with_a_notice():
    blind, mean = load_spec("toy_methods:BLIND"), load_spec("toy_methods:MEAN")
    strategy, notice = effective_strategy(blind, "joint")
    assert strategy == "pooled" and "blind takes no period" in notice
    assert effective_strategy(blind, "separate") == ("separate", None)
    assert effective_strategy(blind, "sequential") == ("sequential", None)
    assert effective_strategy(mean, "joint") == ("joint", None)
    with pytest.raises(ConfigError, match="joint, pooled, separate"):
        effective_strategy(mean, "together")


def test_scenes_without_points_are_refused(make_scene):
    scene = make_scene()
    check_points(scene)
    seen = np.zeros(len(scene.points.track_frame), bool)
    rank = np.arange(len(scene.frames), dtype=np.int32)
    check_points(replace(scene, points=scene.points.select_observations(seen, rank)))
    with pytest.raises(SceneError, match="found none; triangulate some: chronoscene triangulate"):
        check_points(replace(scene, points=Points.empty()))


def test_points_in_one_place_are_refused(make_scene):
    scene = make_scene()
    points = replace(scene.points, xyz=np.ones_like(scene.points.xyz))
    message = "expected sparse points in different places, found 11 in one place; triangulate"
    with pytest.raises(SceneError, match=message):
        parts_of(replace(scene, points=points), "joint")
