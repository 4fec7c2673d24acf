"""MatrixCity: units, blocks, splits, periods."""

import json
import math

import numpy as np
import pytest

from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import detect, find_scenes, matrixcity, read_scene
from chronoscene.scene.geometry import camera_centre

EYE_FROM_NADIR = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]


def put(path, data):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(data))


def pose(x, y, z, *, scale=1.0):
    """Looks straight down (OpenGL axes: along -z), at x, y, z."""
    matrix = np.eye(4)
    matrix[:3, :3] *= scale
    matrix[:3, 3] = x, y, z
    return matrix.tolist()


@pytest.fixture
def prepared(tmp_path):
    """A city with prepared poses of two blocks; images are not needed, as sizes are given."""
    root = tmp_path / "aerial"
    top = {"w": 1920, "h": 1080, "fl_x": 2317.6, "fl_y": 2317.6, "cx": 960, "cy": 540}
    for block in ("block_1", "block_2"):
        for kind, count in (("train", 3), ("test", 1)):
            frames = [
                {
                    "file_path": f"../../{kind}/{block}/{i:04d}.png",
                    "transform_matrix": pose(i, 2, 1.5),
                }
                for i in range(count)
            ]
            put(root / f"pose/{block}/transforms_{kind}.json", {**top, "frames": frames})
    return root


def test_raw_poses_are_in_metres_with_scaled_rotation(raw_city):
    folder = raw_city(["block_A"])
    frames = [{"frame_index": i, "rot_mat": pose(10, 20 + i, 150, scale=0.01)} for i in range(3)]
    put(folder / "block_A/transforms.json", {"camera_angle_x": 0.8, "frames": frames})
    scene = read_scene(folder)
    assert scene.world.unit == "metre"
    assert [f.name for f in scene.frames] == [f"block_A/{i:04d}.png" for i in range(3)]
    first = scene.frames[0]
    np.testing.assert_allclose(camera_centre(first.cam_from_world), [10, 20, 150], atol=1e-12)
    np.testing.assert_allclose(first.cam_from_world[:3, :3], np.diag([1, -1, -1]), atol=1e-12)
    assert first.camera.params[0] == pytest.approx(32 / math.tan(0.4))
    below = first.cam_from_world @ [10, 20, 0, 1]
    np.testing.assert_allclose(below[:3], [0, 0, 150], atol=1e-9)  # in front of the camera


def test_a_block_alone_is_a_scene(raw_city):
    folder = raw_city(["block_A"]) / "block_A"
    assert detect(folder).name == "matrixcity"
    scene = read_scene(folder)
    assert [f.name for f in scene.frames] == ["0000.png", "0001.png", "0002.png"]


def test_a_folder_of_scenes_is_no_city(raw_city, make_scene_folder):
    """A city in it would hide the other scenes."""
    folder = raw_city(["city", "other_city"], name="data")
    assert [s.path for s in find_scenes(folder)] == [folder]
    make_scene_folder(name="data/plaza")
    found = find_scenes(folder)
    assert [(s.path.name, s.name) for s in found] == [
        ("city", "matrixcity"),
        ("other_city", "matrixcity"),
        ("plaza", "chronoscene"),
    ]


def test_blocks_of_one_city_are_one_period(raw_city):
    folder = raw_city(["block_A", "block_B"])
    assert read_scene(folder).num_periods == 1
    scene = read_scene(folder, period_by="folder")
    assert [p.label for p in scene.periods] == ["block_A", "block_B"]
    with pytest.raises(ConfigError, match="one of one, folder, found 'year'"):
        read_scene(folder, period_by="year")


def test_folders_of_blocks_are_periods(raw_city):
    scene = read_scene(
        raw_city([f"{p}/{b}" for p in ("t2", "t10") for b in ("block_A", "block_B")])
    )
    assert [p.label for p in scene.periods] == ["t2", "t10"]
    assert len(scene.select(period=1)) == 6


def test_train_and_test_folders_are_the_split(raw_city):
    scene = read_scene(raw_city(["train/block_1", "test/block_1_test", "train_dense/block_1"]))
    assert scene.num_periods == 1
    assert {f.name.split("/")[0]: f.split for f in scene.frames} == {
        "train": "train",
        "test": "test",
    }
    assert scene.split_rule == "the files of test images"


def test_train_dense_counts_where_it_is_alone(raw_city):
    assert len(read_scene(raw_city(["train_dense/block_1", "test/block_1"])).frames) == 6


def test_prepared_poses_are_in_units_of_100_m(prepared):
    assert detect(prepared).name == "matrixcity"
    scene = read_scene(prepared)
    assert len(scene.frames) == 8 and scene.num_periods == 1
    assert len(scene.select(split="test")) == 2
    frame = next(f for f in scene.frames if f.name == "train/block_1/0002.png")
    np.testing.assert_allclose(camera_centre(frame.cam_from_world), [200, 200, 150], atol=1e-9)
    assert frame.camera.params == (2317.6, 2317.6, 960, 540)


def test_intrinsics_of_a_frame_win(prepared):
    file = prepared / "pose/block_1/transforms_train.json"
    data = json.loads(file.read_text())
    data["frames"][0] |= {"fl_x": 1000, "fl_y": 1000, "camera_model": "SIMPLE_PINHOLE"}
    put(file, data)
    cameras = {f.camera.model: f.camera.params for f in read_scene(prepared).frames}
    assert cameras["SIMPLE_PINHOLE"] == (1000, 960, 540)


def test_paths_that_leave_the_scene_are_refused(prepared):
    with pytest.raises(SceneError, match="expected a file_path inside the scene folder"):
        read_scene(prepared / "pose", format="matrixcity")


@pytest.mark.parametrize(
    ("frame", "message"),
    [
        ({"frame_index": 0, "rot_mat": EYE_FROM_NADIR}, "expected a rotation"),
        ({"frame_index": 0, "rot_mat": pose(0, 0, 0, scale=-0.01)}, "expected a rotation"),
        ({"frame_index": -1, "rot_mat": pose(0, 0, 0, scale=0.01)}, "a frame_index 0, 1, ..."),
        ({"frame_index": "../x", "rot_mat": pose(0, 0, 0, scale=0.01)}, "a frame_index 0, 1,"),
        ({"frame_index": 0, "rot_mat": [[1, 2], [3]]}, "a matrix of 4 x 4 numbers"),
        ({"frame_index": 0}, "a matrix of 4 x 4 numbers"),
    ],
)
def test_frames_that_are_refused(raw_city, frame, message):
    folder = raw_city(["block_A"])
    text = json.dumps({"camera_angle_x": 0.8, "frames": [frame], "mark": {"rot_mat": 0}})
    (folder / "block_A/transforms.json").write_text(text)
    with pytest.raises(SceneError, match=message):
        read_scene(folder)


def test_a_block_without_its_file_is_refused(raw_city):
    folder = raw_city(["block_A", "block_B"])
    (folder / "block_A/transforms.json").unlink()
    with pytest.raises(
        SceneError, match=r'block_A: expected transforms\.json with "rot_mat" beside'
    ):
        read_scene(folder)


def test_says_that_there_are_no_points(raw_city):
    folder = raw_city(["block_A"])
    assert len(read_scene(folder).points) == 0
    assert "without points" in matrixcity.remarks(folder)[0]


def test_an_image_twice_in_a_file_is_refused(raw_city):
    folder = raw_city(["block_A"])
    file = folder / "block_A/transforms.json"
    data = json.loads(file.read_text())
    data["frames"][2]["frame_index"] = 1
    file.write_text(json.dumps(data))
    with pytest.raises(SceneError, match=r"each image once, found 'block_A/0001\.png' twice"):
        read_scene(folder)


@pytest.mark.parametrize("shift", [0.0, 1.0])
def test_files_that_repeat_images_must_agree(raw_city, shift):
    folder = raw_city(["block_A"])
    frames = json.loads((folder / "block_A/transforms.json").read_text())["frames"]
    (folder / "block_A/transforms.json").unlink()
    for block, step in (("block_A", 0.0), ("block_all", shift)):
        listed = []
        for i, frame in enumerate(frames):
            pose = np.array(frame["rot_mat"])
            pose[:3, :3] *= 100
            pose[:3, 3] = (pose[:3, 3] + step) / 100
            listed.append({"file_path": f"../../block_A/{i:04d}.png"})
            listed[-1]["transform_matrix"] = pose.tolist()
        (folder / "pose" / block).mkdir(parents=True)
        text = json.dumps({"camera_angle_x": 1.0, "frames": listed})
        (folder / "pose" / block / "transforms_train.json").write_text(text)
    if shift:
        with pytest.raises(SceneError, match="the same pose in all pose files"):
            read_scene(folder)
    else:
        assert len(read_scene(folder).frames) == 3


def test_files_that_are_not_read_are_remarked_upon(raw_city):
    folder = raw_city(["train/block_A", "train_dense/block_A", "test/block_B"])
    (remark,) = matrixcity.remarks(folder)[1:]
    assert remark.startswith("1 pose files") and "train_dense/block_A/transforms" in remark
