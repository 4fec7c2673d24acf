"""Any scene, through every format that can be written: what the format can hold comes back."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from chronoscene.formats import load_format, read_scene, writable_formats
from chronoscene.scene import Camera, Frame, Period, Points, Scene, WorldFrame
from chronoscene.scene.geometry import pose_from_rotation_translation, rotation_from_quaternion
from chronoscene.scene.splits import split_hash

quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 1e-3)
positions = st.tuples(*[st.floats(-1e4, 1e4)] * 3)
labels = st.text(st.characters(codec="utf-8", exclude_categories=("C", "Z")), min_size=1)
NO_SLASHES = str.maketrans("", "", "/\\:")

models = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "OPENCV_FISHEYE": 8,
}


@st.composite
def cameras(draw, camera_id):
    model = draw(st.sampled_from(sorted(models)))
    focals = 2 if model in ("PINHOLE", "OPENCV", "OPENCV_FISHEYE") else 1
    params = [draw(st.floats(1, 1e4)) for _ in range(focals)]
    params += [draw(st.floats(-1e3, 1e4)) for _ in range(2)]
    params += [draw(st.floats(-0.5, 0.5)) for _ in range(models[model] - len(params))]
    size = (draw(st.integers(1, 5000)), draw(st.integers(1, 5000)))
    return Camera(camera_id, model, *size, tuple(params))


@st.composite
def scenes(draw):
    count = draw(st.integers(2, 5))
    texts = draw(st.lists(labels, min_size=count, max_size=count))
    names = [f"{text.translate(NO_SLASHES)}_{i}.png" for i, text in enumerate(texts)]
    periods = [0, 1, *(draw(st.integers(0, 1)) for _ in range(count - 2))]
    frames = tuple(
        Frame(
            name=name,
            image_id=i + 7,
            camera=draw(cameras(i + 1)),
            cam_from_world=pose_from_rotation_translation(
                rotation_from_quaternion(draw(quaternions)), draw(positions)
            ),
            period=period,
            split=draw(st.sampled_from(["train", "test"])) if i else "train",
        )
        for i, (name, period) in enumerate(zip(sorted(names), periods, strict=True))
    )
    n = draw(st.integers(0, 3))
    xyz = np.array([draw(positions) for _ in range(n)]).reshape(n, 3)
    points = dataclasses.replace(
        Points.empty(),
        ids=np.arange(1, n + 1),
        xyz=xyz,
        rgb=np.full((n, 3), draw(st.integers(0, 255)), np.uint8),
        error=np.full(n, -1.0),
        track_start=np.zeros(n + 1, np.int64),
    )
    table = (Period(0, draw(labels)), Period(1, draw(labels), "2023-04"))
    world = WorldFrame("metre", "EPSG:32650", draw(positions))
    return frames, points, table, world


LIMITED = ("cl-splats", "neusc", "wat")
"""Formats for a certain loader, which hold neither any camera nor any split."""


@pytest.mark.parametrize("name", [name for name in writable_formats() if name not in LIMITED])
@given(parts=scenes())
def test_round_trip(tmp_path_factory, name, parts):
    """Poses to rounding, all else exactly; `colmap-folders` has other names."""
    frames, points, table, world = parts
    root = tmp_path_factory.mktemp("round")
    (root / "images").mkdir()
    scene = Scene("s", root, root / "images", frames, points, table, "x", "x", world)
    for frame in frames:
        scene.image_path(frame).write_text(frame.name)
    again = read_scene(load_format(name).write(scene, root / "out"))
    assert again.format == name
    new = {again.image_path(f).read_text(): f for f in again.frames}
    assert len(new) == len(again.frames) == len(frames)
    for old in frames:
        assert_same_frame(old, new[old.name])
        assert new[old.name].name == old.name or name == "colmap-folders"
    np.testing.assert_array_equal(again.points.xyz, points.xyz)
    np.testing.assert_array_equal(again.points.rgb, points.rgb)
    assert (again.periods, again.world) == (table, world)
    if name != "colmap-folders":
        assert split_hash(again) == split_hash(scene)


def assert_same_frame(a, b):
    assert (a.image_id, a.period, a.split) == (b.image_id, b.period, b.split)
    same = ("model", "width", "height", "params")
    assert all(getattr(a.camera, key) == getattr(b.camera, key) for key in same)
    tolerance = 1e-14 * (1 + np.abs(a.cam_from_world).max())
    np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, rtol=0, atol=tolerance)
