"""CL-Splats: real scenes and rendered levels."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest

from chronoscene.errors import ConfigError, ImageError, SceneError
from chronoscene.formats import cl_splats, detect, read_scene
from chronoscene.formats.shared.ply import write_points
from chronoscene.scene import Camera

REAL = [f"day_{day}_{i:02d}.png" for day in (2, 10) for i in range(4)] + ["frame_1.png"]


def test_days_are_periods_and_other_names_day_0(colmap_folder):
    scene = read_scene(colmap_folder(REAL))
    assert scene.format == "cl-splats"
    assert [p.label for p in scene.periods] == ["day 0", "day 2", "day 10"]
    periods = {f.name: f.period for f in scene.frames}
    assert (periods["frame_1.png"], periods["day_2_00.png"], periods["day_10_00.png"]) == (0, 1, 2)


def test_a_model_counts_more_than_poses_in_other_files(colmap_folder):
    """As in the loader of CL-Splats, and in the validator."""
    folder = colmap_folder(REAL)
    (folder / "transforms_train.json").write_text('{"frames": []}')
    scene = read_scene(folder)
    assert (scene.num_periods, len(scene.frames)) == (3, len(REAL)) and len(scene.points)


def test_every_8th_of_all_is_for_testing(colmap_folder):
    tests = [f.name for f in read_scene(colmap_folder(REAL)).select(split="test")]
    assert tests == [sorted(REAL)[0], sorted(REAL)[8]]


def test_levels(level):
    scene = read_scene(level(("add", "delete", "move", "multi")))
    assert [p.label for p in scene.periods] == ["base", "add", "delete", "move", "multi"]
    names = [f.name for f in scene.frames]
    assert names[:3] == ["add/images/r_0.png", "add/images/r_1.png", "add/images/r_2.png"]
    assert [f.name for f in scene.select(period=0)] == [f"images/r_{i}.png" for i in range(3)]
    focal = 32 / math.tan(0.55)
    np.testing.assert_allclose(scene.frames[0].camera.params, (focal, focal, 32, 24))


def test_base_and_one_change(level):
    folder = level(("add", "move"))
    scene = read_scene(folder, period_by="change:move")
    assert [p.label for p in scene.periods] == ["base", "move"]
    assert {f.name.split("/")[0] for f in scene.frames} == {"images", "move"}
    with pytest.raises(ConfigError, match="step, change:add, change:move, found 'change:delete'"):
        read_scene(folder, period_by="change:delete")


def test_photos_of_days_have_no_changes(colmap_folder):
    with pytest.raises(ConfigError, match="expected step, as the images are named day_<n>"):
        read_scene(colmap_folder(REAL), period_by="change:add")


def test_test_file_decides(level):
    folder = level(("add",))
    data = json.loads((folder / "add/transforms_train.json").read_text())
    test = {**data, "frames": [data["frames"].pop()]}
    (folder / "add/transforms_train.json").write_text(json.dumps(data))
    (folder / "add/transforms_test.json").write_text(json.dumps(test))
    scene = read_scene(folder)
    assert [f.name for f in scene.select(split="test")] == ["add/images/r_2.png"]
    assert scene.split_rule == "transforms_test.json"


def test_points_of_a_level(level, make_scene_folder):
    points = read_scene(make_scene_folder()).points
    folder = level()
    assert len(read_scene(folder).points) == 0
    write_points(folder / "points3d.ply", points)
    np.testing.assert_array_equal(read_scene(folder).points.xyz, points.xyz)


@pytest.mark.parametrize(
    "path", ["../../etc/passwd", "/etc/passwd", "C:/x", "..\\..\\x", "a/../.."]
)
def test_hostile_paths_are_refused(level, path):
    folder = level(("add",))
    file = folder / "transforms_train.json"
    data = json.loads(file.read_text())
    data["frames"][1]["file_path"] = path
    file.write_text(json.dumps(data))
    with pytest.raises(SceneError, match=r"frames\[1\]: expected a file_path inside the scene"):
        read_scene(folder)


def test_a_missing_image_whose_size_is_needed(level):
    folder = level(("add",))
    (folder / "images/r_1.png").unlink()
    with pytest.raises(ImageError, match=r"images/r_1\.png: expected an image, found nothing"):
        read_scene(folder)


@pytest.mark.parametrize(
    "names",
    [
        ["a/0.png", "b/0.png", "b/1.png"],
        ["x 1.png", "y.1.png"],
        ["day_0_a.png", "day_0_b.png"],  # one step in two periods
    ],
)
def test_what_is_written_says_the_time_step_in_the_name(make_scene_folder, tmp_path, names):
    scene = read_scene(make_scene_folder({name: min(i, 1) for i, name in enumerate(names)}))
    out = cl_splats.write(scene, tmp_path / "out", image_source="symlink")
    assert detect(out).name == "cl-splats"
    again = read_scene(out)
    sources = {again.image_path(f).resolve(): f for f in again.frames}
    for frame in scene.frames:
        new = sources[scene.image_path(frame).resolve()]
        assert new.name == f"day_{frame.period}_{frame.name.replace('/', '_')}"
        assert new.period == frame.period
    assert "the split, because its loader takes every 8th image of all" in " ".join(
        cl_splats.losses(scene.with_frames([replace(f, split="train") for f in scene.frames]))
    )


def test_names_that_would_become_one_are_refused(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder({"a/0.png": 0, "a_0.png": 0, "b/0.png": 1}))
    with pytest.raises(SceneError, match="distinct image names, found '"):
        cl_splats.write(scene, tmp_path / "out")


def test_cameras_that_cl_splats_lacks_are_refused(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    straight = Camera(1, "OPENCV", 64, 48, (50, 52, 30, 25.5, 0, 0, 0, 0))
    same = scene.with_frames([replace(f, camera=straight) for f in scene.frames])
    again = read_scene(cl_splats.write(same, tmp_path / "same"))
    assert again.frames[0].camera == Camera(1, "PINHOLE", 64, 48, (50, 52, 30, 25.5))
    camera = Camera(1, "OPENCV", 64, 48, (50, 52, 30, 25.5, 0, 0.1, 0, 0))
    bent = scene.with_frames([replace(f, camera=camera) for f in scene.frames])
    with pytest.raises(SceneError, match="camera 1: expected a camera that CL-Splats reads"):
        cl_splats.write(bent, tmp_path / "out")
