"""nerfstudio's transforms.json: intrinsics, poses, periods, lists, worlds, writing."""

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.errors import SceneError
from chronoscene.formats import nerfstudio, read_scene
from chronoscene.formats.shared.transforms import CameraTable, opengl_from_pose, pose_from_opengl
from chronoscene.scene import Camera, Period
from chronoscene.scene.geometry import pose_from_rotation_translation, rotation_from_quaternion
from chronoscene.scene.similarity import Sim3
from chronoscene.validation.run import validate_scene

NAMES = [f"{i}.png" for i in range(4)]


def edit(folder, **keys):
    """Change keys of the file; None deletes."""
    file = folder / "transforms.json"
    data = json.loads(file.read_text()) | keys
    file.write_text(json.dumps({k: v for k, v in data.items() if v is not None}))


def edit_frames(folder, change):
    file = folder / "transforms.json"
    data = json.loads(file.read_text())
    for i, frame in enumerate(data["frames"]):
        change(i, frame)
    file.write_text(json.dumps(data))


def camera(**keys):
    return CameraTable().camera("place", {"w": 640, "h": 480, "fl_x": 500, **keys}, None)


@pytest.mark.parametrize(
    ("keys", "model", "params"),
    [
        ({}, "PINHOLE", (500, 500, 320, 240)),
        ({"fl_y": 510, "cx": 300, "cy": 250.5}, "PINHOLE", (500, 510, 300, 250.5)),
        ({"k1": 0, "k2": 0.0}, "PINHOLE", (500, 500, 320, 240)),
        ({"k1": 0.1}, "OPENCV", (500, 500, 320, 240, 0.1, 0, 0, 0)),
        ({"k2": 0.1, "p2": 0.2}, "OPENCV", (500, 500, 320, 240, 0, 0.1, 0, 0.2)),
        ({"k3": 0.3, "p1": 1}, "FULL_OPENCV", (500, 500, 320, 240, 0, 0, 1, 0, 0.3, 0, 0, 0)),
        ({"distortion_params": [1, 2, 0, 0, 3, 4]}, "OPENCV", (500, 500, 320, 240, 1, 2, 3, 4)),
        ({"camera_model": "SIMPLE_RADIAL", "k1": 0.1}, "SIMPLE_RADIAL", (500, 320, 240, 0.1)),
        ({"camera_model": "PINHOLE", "k1": 0.1}, "OPENCV", (500, 500, 320, 240, 0.1, 0, 0, 0)),
        (
            {"camera_model": "OPENCV_FISHEYE", "k1": 1, "k4": 4},
            "OPENCV_FISHEYE",
            (500, 500, 320, 240, 1, 0, 0, 4),
        ),
        ({"is_fisheye": True, "k1": 1}, "OPENCV_FISHEYE", (500, 500, 320, 240, 1, 0, 0, 0)),
        ({"fl_x": None, "camera_angle_x": np.pi / 2}, "PINHOLE", (320, 320, 320, 240)),
    ],
)
def test_cameras(keys, model, params):
    result = camera(**keys)
    assert (result.model, result.width, result.height) == (model, 640, 480)
    assert result.params == pytest.approx(params, rel=1e-15)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"fl_x": None}, "a positive fl_x, or camera_angle_x"),
        ({"fl_x": 0}, "a positive fl_x"),
        ({"fl_x": -5}, "a positive fl_x"),
        ({"fl_x": "5"}, "a finite number as fl_x"),
        ({"fl_x": float("nan")}, "a finite number as fl_x"),
        ({"fl_x": 10**400}, "a finite number as fl_x"),
        ({"cx": True}, "a finite number as cx"),
        ({"w": 640.5}, "w and h in whole pixels"),
        ({"h": 0}, "w and h in whole pixels"),
        ({"w": 10**12}, "w and h in whole pixels"),
        ({"fl_x": None, "camera_angle_x": 4}, "camera_angle_x between 0 and pi"),
        ({"camera_model": "FISHEYE624"}, "a camera_model SIMPLE_PINHOLE, PINHOLE"),
        ({"camera_model": ["PINHOLE"]}, "a camera_model SIMPLE_PINHOLE, PINHOLE"),
        ({"k4": 0.1}, "distortion of OPENCV, found k4"),
        ({"camera_model": "SIMPLE_PINHOLE", "fl_y": 510}, "equal fl_x and fl_y"),
        ({"distortion_params": 3}, "distortion_params k1"),
        ({"distortion_params": [0] * 7}, "distortion_params k1"),
    ],
)
def test_cameras_that_are_refused(keys, message):
    with pytest.raises(SceneError, match=message):
        camera(**keys)


def test_frames_of_equal_intrinsics_share_a_camera(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    edit_frames(folder, lambda i, frame: frame.update(fl_x=60.0 if i == 0 else 50.0))
    cameras = [f.camera for f in read_scene(folder).frames]
    assert len({c.camera_id for c in cameras}) == len(set(cameras)) == 2


@pytest.mark.parametrize(
    ("of_file", "of_frame", "focals"),
    [
        ({"fl_x": 50, "fl_y": 50}, {"camera_angle_x": np.pi / 2}, (32, 32)),
        ({"fl_x": 50, "fl_y": 50}, {"camera_angle_y": np.pi / 2}, (50, 24)),
        ({"camera_angle_x": 1, "camera_angle_y": 2}, {"camera_angle_x": np.pi / 2}, (32, 32)),
        ({"camera_angle_x": 1}, {"fl_x": 60}, (60, 60)),
        ({"fl_x": 50}, {"camera_angle_x": np.pi / 2, "fl_y": 51}, (32, 51)),
        ({"fl_x": 50}, {"camera_angle_x": None}, (50, 50)),
    ],
)
def test_the_focal_length_of_a_frame_overrides_that_of_the_file(
    nerfstudio_folder, of_file, of_frame, focals
):
    folder = nerfstudio_folder(NAMES)
    edit(folder, **{"fl_x": None, "fl_y": None, "w": 64, "h": 48, **of_file})
    edit_frames(folder, lambda i, frame: frame.update(of_frame if i == 0 else {}))
    camera = read_scene(folder).frames[-1].camera  # the file has them in reverse
    assert (camera.K[0, 0], camera.K[1, 1]) == pytest.approx(focals)


def test_the_distortion_of_a_frame_overrides_that_of_the_file(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    edit(folder, is_fisheye=True, distortion_params=[0.1, 0, 0, 0])
    edit_frames(
        folder, lambda i, frame: i == 0 and frame.update(camera_model="OPENCV", k1=0.2, k2=0.3)
    )
    *_, other, first = (f.camera for f in read_scene(folder).frames)  # reversed in the file
    assert (first.model, first.params[4:]) == ("OPENCV", (0.2, 0.3, 0, 0))
    assert (other.model, other.params[4:]) == ("OPENCV_FISHEYE", (0.1, 0, 0, 0))


def test_periods_from_times(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES, periods=False)
    edit_frames(folder, lambda i, frame: frame.update(time=[0.5, 0.25, 0.5, 0.25][i]))
    scene = read_scene(folder)
    assert [p.label for p in scene.periods] == ["0.25", "0.5"]
    assert [f.period for f in scene.frames] == [0, 1, 0, 1]


def test_labels_tell_close_times_apart(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES, periods=False)
    edit_frames(folder, lambda i, frame: frame.update(time=20160501.0 + i % 2))
    assert [p.label for p in read_scene(folder).periods] == ["20160501", "20160502"]


def test_a_time_for_every_frame_needs_a_grouping(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES, periods=False)
    edit_frames(folder, lambda i, frame: frame.update(time=[3.0, 2.0, 1.0, 0.0][i]))
    with pytest.raises(SceneError, match=r"json.*found 4 times of 4 frames.*count:N or gap:X"):
        read_scene(folder)
    report = validate_scene(folder)  # a scene among others must not end the command
    assert [(f.code, f.place) for f in report.findings] == [("CS007", "transforms.json")]
    assert [f.period for f in read_scene(folder, period_by="count:2").frames] == [0, 1, 1, 1]


def test_without_periods_there_is_one(nerfstudio_folder):
    assert read_scene(nerfstudio_folder(NAMES, periods=False)).periods == (Period(0, "0"),)


def test_periods_from_a_table(nerfstudio_folder, tmp_path):
    table = tmp_path / "t.csv"
    table.write_text("file,period\n0.png,b\n1.png,a\n2.png,a\nimages/3.png,b\n")
    scene = read_scene(nerfstudio_folder(NAMES), period_by=f"table:{table}")
    assert [scene.periods[f.period].label for f in scene.frames] == list("baab")


@pytest.mark.parametrize("ids", [[0, 2, 0, 2], [0, -1, 0, 1], [0, None, 0, 1], [0, "1", 0, 1]])
def test_period_ids_that_are_refused(nerfstudio_folder, ids):
    folder = nerfstudio_folder(NAMES)
    edit_frames(folder, lambda i, frame: frame.update(period=ids[i]))
    with pytest.raises(
        SceneError, match=r"expected (a period 0, 1, \.\.\.|periods 0\.\.1 without)"
    ):
        read_scene(folder)


def test_lists_of_names(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    images = [f"images/{name}" for name in NAMES]
    edit(folder, train_filenames=images[:2], test_filenames=[images[3]])
    scene = read_scene(folder)
    assert [(f.name, f.split) for f in scene.frames] == [
        ("0.png", "train"),
        ("1.png", "train"),
        ("3.png", "test"),
    ]
    assert nerfstudio.remarks(folder) == ["1 frame left out: in no list"]
    edit(folder, val_filenames=images[:1])
    with pytest.raises(SceneError, match=r"without common names, found 'images/0.png'"):
        read_scene(folder)
    edit(folder, train_filenames=None)
    assert len(read_scene(folder).select(split="test")) == 2


def test_masks_are_those_that_the_frames_name(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    edit_frames(folder, lambda i, frame: frame.update({"mask_path": "cut/x.png"} if i < 3 else {}))
    with pytest.raises(SceneError, match=r"cut/x\.png: expected a mask, found nothing"):
        read_scene(folder)
    (folder / "cut").mkdir()
    Image.new("L", (64, 48)).save(folder / "cut/x.png")
    scene = read_scene(folder)
    assert scene.masks == dict.fromkeys(["1.png", "2.png", "3.png"], folder / "cut/x.png")
    assert nerfstudio.remarks(folder) == []
    (lost,) = [item for item in nerfstudio.losses(scene) if "masks" in item]
    assert lost == "masks of some frames only, as its loader wants one for each or for none"
    edit_frames(folder, lambda i, frame: frame.update(mask_path="../x.png"))
    with pytest.raises(SceneError, match=r"frames\[3\]: mask_path: expected a file_path inside"):
        read_scene(folder)


def test_frames_without_image_are_left_out(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    (folder / "images/2.png").unlink()
    assert [f.name for f in read_scene(folder).frames] == ["0.png", "1.png", "3.png"]
    assert "1 frame left out: no image" in nerfstudio.remarks(folder)
    for name in NAMES:
        (folder / "images" / name).unlink(missing_ok=True)
    with pytest.raises(SceneError, match="expected an image, found nothing"):
        read_scene(folder)


@pytest.mark.parametrize("key", ["file_path", "ply_file_path"])
@pytest.mark.parametrize(
    "path", ["../x.png", "/etc/passwd", "images/../../x.png", "C:\\x.png", "..\\x", "\\\\h\\x", 3]
)
def test_hostile_paths_are_refused(nerfstudio_folder, key, path):
    folder = nerfstudio_folder(NAMES)
    if key == "file_path":
        edit_frames(folder, lambda i, frame: frame.update(file_path=path) if i == 1 else None)
    else:
        edit(folder, ply_file_path=path)
    with pytest.raises(SceneError, match="expected a file_path"):
        read_scene(folder)


def test_names_without_extension_are_png(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    edit_frames(folder, lambda i, frame: frame.update(file_path=f"./images/{i}"))
    edit(folder, test_filenames=["images/2"])
    scene = read_scene(folder)
    assert [f.name for f in scene.frames] == NAMES
    assert [f.name for f in scene.select(split="test")] == ["2.png"]


@pytest.mark.parametrize("suffix", [".jpg", ".v1.png", ".2016.JPG"])
def test_left_out_extensions_are_found_out(nerfstudio_folder, suffix):
    """instant-ngp takes .png; files say what else there is, also behind other dots."""
    folder = nerfstudio_folder(NAMES)
    for path in list((folder / "images").iterdir()):
        path.rename(path.with_suffix(suffix))
    written = suffix.rpartition(".")[0]
    edit_frames(folder, lambda i, frame: frame.update(file_path=f"images/{i}{written}"))
    edit(folder, test_filenames=[f"images/2{written}"])
    scene = read_scene(folder)
    assert [f.name for f in scene.frames] == [f"{i}{suffix}" for i in range(4)]
    assert [f.name for f in scene.select(split="test")] == [f"2{suffix}"]


def test_frames_without_image_are_left_out_where_images_say_the_size(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    edit(folder, w=None, h=None, cx=None, cy=None)
    (folder / "images/1.png").unlink()
    edit(folder, test_filenames=["images/1.png", "images/2.png"])
    scene = read_scene(folder)
    assert [(f.name, f.split) for f in scene.frames] == [
        ("0.png", "train"),
        ("2.png", "test"),
        ("3.png", "train"),
    ]
    assert (scene.frames[0].camera.width, scene.frames[0].camera.height) == (64, 48)
    assert "1 frame left out: no image" in nerfstudio.remarks(folder)


def test_names_that_no_disk_can_hold_count_as_missing(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    long = "x" * 300
    edit_frames(folder, lambda i, f: f.update(file_path=f"images/{long}.png") if i == 0 else None)
    assert len(read_scene(folder).frames) == 3


def test_lists_with_names_of_no_frame_are_refused(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    edit(folder, val_filenames=["images/0.png", "images/9.png"])
    with pytest.raises(
        SceneError, match=r"val_filenames: expected names of frames, found 'images/"
    ):
        read_scene(folder)


def test_images_beside_the_folder_of_images(nerfstudio_folder):
    folder = nerfstudio_folder(NAMES)
    (folder / "images/3.png").rename(folder / "3.png")
    edit_frames(
        folder,
        lambda i, frame: frame.update(file_path=frame["file_path"].replace("es/3", "es/../3")),
    )
    scene = read_scene(folder)
    assert [f.name for f in scene.frames] == ["3.png", *(f"images/{i}.png" for i in range(3))]
    assert all(scene.image_path(f).is_file() for f in scene.frames)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transform_matrix": [[1, 0, 0, 0]] * 4}, "a last row 0 0 0 1"),
        ({"transform_matrix": (2 * np.eye(4)).tolist()}, "a last row 0 0 0 1"),
        ({"transform_matrix": np.diag([2, 2, 2, 1]).tolist()}, "a rotation .* one scaled by 2"),
        ({"transform_matrix": np.diag([1, 1, -1, 1]).tolist()}, "a rotation .* a mirrored one"),
        ({"transform_matrix": np.diag([1, 1.1, 1, 1]).tolist()}, "a rotation .* a skewed one"),
        ({"transform_matrix": [[float("nan")] * 4] * 4}, "x 4 numbers, found NaN"),
        ({"transform_matrix": [[1e200] * 4] * 4}, "absurdly large numbers"),
        ({"transform_matrix": np.eye(5).tolist()}, "found 5 x 5"),
        ({"transform_matrix": "eye"}, "3 or 4 x 4 numbers"),
        ({"transform_matrix": None}, "3 or 4 x 4 numbers"),
        ({"file_path": "images/0.png"}, "each image once"),
    ],
)
def test_frames_that_are_refused(nerfstudio_folder, change, message):
    folder = nerfstudio_folder(NAMES)
    edit_frames(folder, lambda i, frame: frame.update(change) if i == 1 else None)
    with pytest.raises(SceneError, match=message):
        read_scene(folder)


@pytest.mark.parametrize(
    "text",
    [
        "[]",
        "{",
        '{"frames": []}',
        '{"frames": [1]}',
        '{"frames": [{}], "frames": [{}]}',
        "[" * 1_000_000,
        '{"a":' * 1_000_000,
        '{"w": ' + "9" * 10_000 + "}",
    ],
    ids=lambda text: text[:20],
)
def test_files_that_are_refused(nerfstudio_folder, text):
    folder = nerfstudio_folder(NAMES)
    (folder / "transforms.json").write_text(text)
    with pytest.raises(SceneError, match=r"transforms\.json: expected"):
        read_scene(folder)


def test_applied_transform_and_scale_are_undone(nerfstudio_folder, exact):
    """A world that was turned and scaled on the way to the file is the original one again."""
    folder = nerfstudio_folder(NAMES)
    plain = read_scene(folder)
    turn = rotation_from_quaternion([0.5, 0.1, -0.7, 0.3])
    file_from_original = Sim3(0.25, turn, 0.25 * np.array([1.0, -2.0, 3.0]))
    poses = {f"images/{f.name}": f.cam_from_world for f in plain.frames}

    def move(i, frame):
        pose = file_from_original.apply_to_pose(poses[frame["file_path"]])
        frame["transform_matrix"] = opengl_from_pose(pose).tolist()

    edit_frames(folder, move)
    applied = pose_from_rotation_translation(turn, [1.0, -2.0, 3.0])[:3].tolist()
    edit(folder, applied_transform=applied, applied_scale=0.25)
    moved = read_scene(folder)
    for a, b in zip(plain.frames, moved.frames, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(
        file_from_original.apply(moved.points.xyz), plain.points.xyz, atol=1e-9
    )
    edit(folder, applied_scale=-1)
    with pytest.raises(SceneError, match="a positive applied_scale"):
        read_scene(folder)


def test_the_swap_of_axes_of_old_versions_is_undone(nerfstudio_folder):
    """Files beside the model they were made from, without a word on what was done to it."""
    folder = nerfstudio_folder(NAMES)
    plain = read_scene(folder)
    swap = np.array([[0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0], [0, 0, 0, 1]])

    def move(i, frame):
        frame["transform_matrix"] = (swap @ frame["transform_matrix"]).tolist()

    edit_frames(folder, move)
    swapped = read_scene(folder)
    (folder / "colmap/sparse/0").mkdir(parents=True)
    undone = read_scene(folder)
    for a, b, c in zip(plain.frames, swapped.frames, undone.frames, strict=True):
        assert np.abs(a.cam_from_world - b.cam_from_world).max() > 0.1
        np.testing.assert_allclose(a.cam_from_world, c.cam_from_world, atol=1e-9)
    np.testing.assert_allclose(undone.points.xyz @ swap[:3, :3].T, plain.points.xyz, atol=1e-9)
    assert "swap of axes" in nerfstudio.remarks(folder)[0]
    edit(folder, applied_transform=np.eye(4)[:3].tolist())
    explicit = read_scene(folder)
    np.testing.assert_array_equal(
        explicit.frames[0].cam_from_world, swapped.frames[0].cam_from_world
    )


quaternions = st.tuples(*[st.floats(-1, 1)] * 4).filter(lambda q: sum(x * x for x in q) > 1e-3)
positions = st.tuples(*[st.floats(-1e4, 1e4)] * 3)


@given(quaternions, positions)
def test_poses_survive_the_other_axes(quaternion, position):
    pose = pose_from_rotation_translation(rotation_from_quaternion(quaternion), position)
    again = pose_from_opengl("place", opengl_from_pose(pose))
    np.testing.assert_allclose(again, pose, rtol=0, atol=1e-14 * (1 + np.abs(position).max()))


def test_written_time_runs_from_0_to_1(make_scene_folder, tmp_path):
    names = {f"{i}.png": i % 3 for i in range(6)}
    out = nerfstudio.write(read_scene(make_scene_folder(names)), tmp_path / "out")
    frames = json.loads((out / "transforms.json").read_text())["frames"]
    assert [frame["time"] for frame in frames] == [0, 0.5, 1, 0, 0.5, 1]


def test_a_backslash_in_a_name_is_refused(make_scene_folder, tmp_path):
    """Read again, it is a slash, and the frame would be left out as one without its image."""
    scene = read_scene(make_scene_folder({"a\\b.png": 0, "c.png": 0}))
    with pytest.raises(SceneError, match=r"without backslashes.*found 'a.*rename the image"):
        nerfstudio.write(scene, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_written_points_project_to_where_they_were_seen(make_scene_folder, tmp_path):
    """By the documentation of the format alone: OpenGL camera-to-world, fl, c, PLY in its world."""
    scene = read_scene(make_scene_folder())
    out = nerfstudio.write(scene, tmp_path / "out")
    data = json.loads((out / "transforms.json").read_text())
    body = (out / data["ply_file_path"]).read_bytes().split(b"end_header\n")[1]
    record = np.dtype([("xyz", "<f8", 3), ("rgb", "u1", 3)])
    xyz = np.frombuffer(body, record)["xyz"]
    point = np.repeat(np.arange(len(xyz)), np.diff(scene.points.track_start))
    for j, (i, frame) in enumerate(zip(point, scene.points.track_frame, strict=True)):
        keys = data["frames"][frame]
        x, y, z, _ = np.linalg.inv(keys["transform_matrix"]) @ [*xyz[i], 1]
        pixel = keys["fl_x"] * x / -z + keys["cx"], keys["fl_y"] * -y / -z + keys["cy"]
        np.testing.assert_allclose(pixel, scene.points.track_xy[j], atol=1e-6)


def test_points_that_are_not_finite_are_left_out(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    xyz = scene.points.xyz.copy()
    xyz[3, 1] = np.nan
    scene = dataclasses.replace(scene, points=dataclasses.replace(scene.points, xyz=xyz))
    assert "1 points that are not finite" in nerfstudio.losses(scene)
    again = read_scene(nerfstudio.write(scene, tmp_path / "out"))
    np.testing.assert_array_equal(again.points.xyz, np.delete(xyz, 3, axis=0))


def test_a_third_radial_parameter_is_written(nerfstudio_folder, tmp_path):
    folder = nerfstudio_folder(NAMES)
    edit(folder, k1=0.1, p2=0.02, k3=0.03)
    scene = read_scene(folder)
    assert scene.frames[0].camera.model == "FULL_OPENCV"
    again = read_scene(nerfstudio.write(scene, tmp_path / "out"))
    assert again.frames[0].camera == scene.frames[0].camera


def test_the_kind_of_camera_stands_where_nerfstudio_looks_for_it(make_scene_folder, tmp_path):
    """Once for the whole file; frames of two kinds cannot be told apart there."""
    scene = read_scene(make_scene_folder())
    first, *others = scene.frames
    fisheye = Camera(1, "OPENCV_FISHEYE", 64, 48, (50, 52, 30, 25.5, 0.1, 0, 0, 0))
    all_of_them = scene.with_frames([dataclasses.replace(f, camera=fisheye) for f in scene.frames])
    for case, model in ((scene, "PINHOLE"), (all_of_them, "OPENCV_FISHEYE")):
        out = nerfstudio.write(case, tmp_path / model)
        assert json.loads((out / "transforms.json").read_text())["camera_model"] == model
        assert len(nerfstudio.losses(case)) == 1
    mixed = scene.with_frames([dataclasses.replace(first, camera=fisheye), *others])
    assert "OPENCV_FISHEYE beside other cameras" in nerfstudio.losses(mixed)[1]
    again = read_scene(nerfstudio.write(mixed, tmp_path / "mixed"))
    assert [f.camera.model for f in again.frames] == [f.camera.model for f in mixed.frames]


def test_models_that_the_format_lacks_are_refused(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    odd = Camera(1, "FOV", 64, 48, (50, 50, 32, 24, 0.1))
    frames = [dataclasses.replace(f, camera=odd) for f in scene.frames]
    with pytest.raises(SceneError, match="camera 1: expected a camera model that nerfstudio has"):
        nerfstudio.write(scene.with_frames(frames), tmp_path / "out")
    assert not (tmp_path / "out").exists()
