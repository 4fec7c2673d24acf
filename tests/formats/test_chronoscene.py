"""The ChronoScene format: names, splits, labels, world, writing, and what is refused."""

import dataclasses
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest

from chronoscene.colmap.model import PosedImage
from chronoscene.errors import ChronoSceneError, ConfigError, SceneError
from chronoscene.formats import detect, find_scenes, read_scene
from chronoscene.formats.chronoscene import check_image, read_periods, write
from chronoscene.formats.shared.json_values import is_iso_date
from chronoscene.scene import Camera, Period, WorldFrame
from chronoscene.scene.splits import DEFAULT_RULE


def split_of(scene) -> dict[str, str]:
    return {f.name: f.split for f in scene.frames}


def put(folder, name: str, text: str) -> None:
    (folder / name).write_text(text, encoding="utf-8")


@pytest.mark.parametrize("form", ["binary", "old", "text"])
def test_every_form_of_a_model(make_scene_folder, form):
    scene = read_scene(make_scene_folder(form=form))
    assert [f.name for f in scene.frames] == [
        "a/0001.png",
        "a/0002.png",
        "b/0001.png",
        "b/0003.png",
    ]
    assert [f.period for f in scene.frames] == [0, 0, 1, 1]
    np.testing.assert_allclose(
        scene.frames[0].camera.K, [[50, 0, 30], [0, 52, 25.5], [0, 0, 1]], rtol=0
    )
    assert len(scene.points) == 30


def test_all_forms_of_one_model_read_equally(make_scene_folder):
    binary = read_scene(make_scene_folder(name="binary"))
    for form in ("old", "text"):
        other = read_scene(make_scene_folder(name=form, form=form))
        np.testing.assert_allclose(other.points.xyz, binary.points.xyz, rtol=1e-14)
        np.testing.assert_allclose(other.points.track_xy, binary.points.track_xy, rtol=1e-14)
        np.testing.assert_array_equal(other.points.track_frame, binary.points.track_frame)
        for a, b in zip(other.frames, binary.frames, strict=True):
            np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, rtol=1e-12, atol=1e-14)


def test_split_entries_in_several_forms(make_scene_folder):
    folder = make_scene_folder({"x/a.1.png": 0, "b.png": 0, "c d.png": 1, "e.jpg": 1})
    put(folder, "sparse/split.txt", "\ufeffx/a.1  0\r\n\r\nb\t0\r\nc d.png \t 1 \r\ne.png 1\r\n")
    assert [f.period for f in read_scene(folder).frames] == [0, 1, 1, 0]


def test_utf_16_as_windows_shells_write_it(make_scene_folder):
    folder = make_scene_folder({"a.png": 0, "b.png": 1})
    (folder / "sparse/split.txt").write_bytes("a.png 0\r\nb.png 1\r\n".encode("utf-16"))
    assert [f.period for f in read_scene(folder).frames] == [0, 1]


def test_test_file_decides_alone(make_scene_folder):
    folder = make_scene_folder(tests=["b/0003", "a/0002.png", "unknown.png"])
    scene = read_scene(folder)
    assert [name for name, split in split_of(scene).items() if split == "test"] == [
        "a/0002.png",
        "b/0003.png",
    ]
    assert scene.split_rule == "sparse/0/test.txt"
    put(folder, "sparse/0/test.txt", "\n")
    assert set(split_of(read_scene(folder)).values()) == {"train"}


def test_default_split_is_stratified(make_scene_folder):
    names = {f"{i:02d}.png": i % 2 for i in range(20)}
    scene = read_scene(make_scene_folder(names))
    tests = [f.name for f in scene.frames if f.split == "test"]
    assert tests == ["00.png", "01.png", "16.png", "17.png"]
    assert scene.split_rule == DEFAULT_RULE


def test_lines_of_images_that_are_not_registered_have_no_effect(make_scene_folder):
    folder = make_scene_folder({"a.png": 0, "b.png": 1})
    put(folder, "sparse/split.txt", "a.png 0\nb.png 1\nlost.png 1\n")
    assert [f.name for f in read_scene(folder).frames] == ["a.png", "b.png"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a/0001.png 0\na/0002.png\n", 'split.txt:2: expected "<image name> <period id>"'),
        ("a/0001.png zero\n", "split.txt:1: expected a period id 0, 1, ..."),
        ("a/0001.png -1\n", "split.txt:1: expected a period id 0, 1, ..."),
        ("0001.png 0\n", "split.txt:1: expected a name that matches one image, found '0001.png'"),
        ("0001 0\n", "matches 'a/0001.png', 'b/0001.png'; write the full names"),
        ("a/0001 0\na/0001.png 1\n", "split.txt:2: expected period 0 for 'a/0001.png' as in line"),
        ("a/0001 0\na/0002 0\nb/0001 1\n", "a period for every registered image, 'b/0003.png'"),
        ("a/0001 0\na/0002 0\nb/0001 2\nb/0003 2\n", "expected period ids 0..1 for 2 periods"),
        ("a/0001 1\na/0002 1\nb/0001 2\nb/0003 2\n", "found 1, 2; number the periods from 0"),
        ("a/0001 0\na/0002 0\nb/0001 0\nb/0003 0\nlost 1\n", "a registered image of period 1"),
        ("", "for every registered image"),
    ],
)
def test_split_files_that_are_refused(make_scene_folder, text, message):
    folder = make_scene_folder()
    put(folder, "sparse/split.txt", text)
    with pytest.raises(SceneError) as error:
        read_scene(folder)
    assert message in str(error.value)


def test_test_file_with_an_ambiguous_name_is_refused(make_scene_folder):
    with pytest.raises(SceneError, match=r"test\.txt:2: expected a name that matches one image"):
        read_scene(make_scene_folder(tests=["a/0001", "0001"]))


@pytest.mark.parametrize("name", ["../out.png", "/etc/x.png", "a/../../b.png", "C:/x.png"])
def test_names_that_leave_the_folder_are_refused(make_scene_folder, name):
    folder = make_scene_folder({"a.png": 0, "b.png": 1}, form="text")
    images = folder / "sparse/0/images.txt"
    images.write_text(images.read_text().replace("a.png", name))
    with pytest.raises(SceneError, match="expected image names below images/"):
        read_scene(folder)


def test_two_images_of_one_name_are_refused(make_scene_folder):
    folder = make_scene_folder({"a.png": 0, "b.png": 1}, form="text")
    images = folder / "sparse/0/images.txt"
    images.write_text(images.read_text().replace("a.png", "b.png"))
    with pytest.raises(SceneError, match="one image of each name"):
        read_scene(folder)


@pytest.mark.parametrize("params", ["0 50 30 25", "nan 50 30 25", "-50 -50 30 25"])
def test_cameras_without_a_focal_length_are_refused(make_scene_folder, params):
    folder = make_scene_folder(form="text")
    put(folder, "sparse/0/cameras.txt", f"1 PINHOLE 64 48 {params}\n")
    with pytest.raises(SceneError):
        read_scene(folder)


@pytest.mark.parametrize(
    "camera",
    [
        Camera(1, "OPENCV", 64, 48, (50, 50, 32, 24, np.nan, 0, 0, 0)),
        Camera(1, "PINHOLE", 64, 48, (50, 50, np.inf, 24)),
        Camera(1, "PINHOLE", 64, 10_000_000, (50, 50, 32, 24)),
        Camera(1, "EQUIRECTANGULAR", 0, 48, (64, 48)),
    ],
)
def test_cameras_of_no_use_are_refused(camera):
    with pytest.raises(SceneError, match="expected a camera 1 with a plausible size"):
        check_image(Path("place"), PosedImage(1, "a.png", camera, np.eye(4)))


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_poses_of_no_use_are_refused(value):
    pose = np.eye(4)
    pose[1, 3] = value
    camera = Camera(1, "PINHOLE", 64, 48, (50, 50, 32, 24))
    with pytest.raises(SceneError, match=r"expected a finite pose of 'a\.png'"):
        check_image(Path("place"), PosedImage(1, "a.png", camera, pose))
    skewed = np.diag([1, 1, 1.001, 1])
    with pytest.raises(SceneError, match=r"expected a rotation in the pose of 'a\.png'"):
        check_image(Path("place"), PosedImage(1, "a.png", camera, skewed))


def test_panoramas_are_read(make_scene_folder):
    """They have no focal length; it is for methods and undistortion to refuse them."""
    folder = make_scene_folder(form="text")
    put(folder, "sparse/0/cameras.txt", "1 EQUIRECTANGULAR 64 48 64 48\n")
    camera = read_scene(folder).frames[0].camera
    assert camera.model == "EQUIRECTANGULAR" and not camera.is_pinhole


def test_periods_and_world(make_scene_folder):
    folder = make_scene_folder()
    put(folder, "sparse/periods.json", '[{"id": 0, "label": "alt"}, {"id": 1, "date": "2023-04"}]')
    put(folder, "sparse/world.json", '{"unit": "metre", "offset": [4e5, 5e6, 1]}')
    scene = read_scene(folder)
    assert scene.periods == (Period(0, "alt"), Period(1, "1", "2023-04"))
    assert scene.world == WorldFrame("metre", None, (4e5, 5e6, 1.0))


def test_a_huge_period_id_is_refused_before_anything_is_allocated(make_scene_folder):
    folder = make_scene_folder()
    assert len(read_periods(folder, 3)) == 3
    for text in (None, "[]"):
        if text is not None:
            put(folder, "sparse/periods.json", text)
        with pytest.raises(SceneError, match="at most 100000 periods, found 1000000000000"):
            read_periods(folder, 10**12)


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("periods.json", "{}"),
        ("periods.json", "[1, 2]"),
        ("periods.json", '[{"id": 0}]'),
        ("periods.json", '[{"id": 1}, {"id": 0}]'),
        ("periods.json", '[{"id": 0}, {"id": 1, "lable": "x"}]'),
        ("periods.json", '[{"id": 0}, {"id": 1, "label": 3}]'),
        ("periods.json", '[{"id": 0}, {"id": 1, "date": "17.4.2023"}]'),
        ("periods.json", '[{"id": 0}, {"id": 1, "date": 2023}]'),
        ("periods.json", "[" * 100_000),
        ("periods.json", '[{"id": 0, "label": "\\ud800"}, {"id": 1}]'),
        ("world.json", "[]"),
        ("world.json", "{"),
        ("world.json", '{"unit": "yard"}'),
        ("world.json", '{"unit": ["metre"]}'),
        ("world.json", '{"crs": 32650}'),
        ("world.json", '{"offset": [1, 2]}'),
        ("world.json", '{"offset": [1, 2, NaN]}'),
        ("world.json", '{"offset": [1, 2, true]}'),
        ("world.json", '{"offset": [1, 2, 1' + "0" * 400 + "]}"),
    ],
)
def test_labels_and_worlds_that_are_refused(make_scene_folder, file, text):
    folder = make_scene_folder()
    put(folder, f"sparse/{file}", text)
    with pytest.raises(SceneError) as error:
        read_scene(folder)
    assert file in str(error.value)


def test_iso_dates():
    assert all(map(is_iso_date, ("2016", "2016-09", "2024-02-29")))
    assert not any(map(is_iso_date, ("", "16", "2023-02-29", "2016-13", "2016-9", "20160901", "x")))


def test_write_keeps_labels_world_and_odd_names(make_scene_folder, tmp_path):
    names = {"old town/a b.1.png": 0, "ü.png": 1}
    scene = read_scene(make_scene_folder(names))
    scene = dataclasses.replace(
        scene,
        periods=(Period(0, "früher", "2016"), Period(1, "später")),
        world=WorldFrame("metre", "EPSG:32650", (442000.0, 4427000.0, 50.5)),
    )
    again = read_scene(write(scene, tmp_path / "out"))
    assert again.periods == scene.periods and again.world == scene.world
    assert [(f.name, f.period) for f in again.frames] == [(f.name, f.period) for f in scene.frames]


def test_write_refuses_a_folder_in_use_and_leaves_it_alone(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("all of it")
    with pytest.raises(SceneError, match="expected a new or empty folder"):
        write(scene, out)
    assert [p.name for p in out.iterdir()] == ["thesis.txt"]


def test_a_failed_write_leaves_nothing_behind(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    scene = read_scene(folder)
    (folder / "images/b/0003.png").unlink()
    with pytest.raises(SceneError, match=r"0003\.png: expected an image"):
        write(scene, tmp_path / "target" / "out")
    assert not (tmp_path / "target").exists()


@pytest.mark.parametrize("name", [" a.png", "a.png\n", "a\rb.png"])
def test_write_refuses_names_that_the_text_files_cannot_hold(make_scene_folder, tmp_path, name):
    scene = read_scene(make_scene_folder({"a.png": 0, "b.png": 1}))
    frames = [dataclasses.replace(scene.frames[0], name=name), scene.frames[1]]
    renamed = dataclasses.replace(scene, frames=tuple(frames))
    with pytest.raises(SceneError, match="name"):
        write(renamed, tmp_path / "out", image_source="none")


def test_image_sources(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    linked = write(scene, tmp_path / "linked", image_source="link")
    source = scene.image_path(scene.frames[0])
    assert os.path.samefile(source, linked / "images" / scene.frames[0].name)
    assert not (write(scene, tmp_path / "none", image_source="none") / "images").exists()
    with pytest.raises(ConfigError, match="copy, link, none"):
        write(scene, tmp_path / "x", image_source="steal")


def test_a_point_without_observations_survives(make_scene_folder, tmp_path):
    folder = make_scene_folder(form="text", points=3)
    with (folder / "sparse/0/points3D.txt").open("a") as file:
        file.write("99 1 2 3 4 5 6 0.5\n")
    scene = read_scene(folder)
    assert scene.points.ids.tolist()[-1] == 99
    assert scene.points.track_start[-1] == scene.points.track_start[-2]
    again = read_scene(write(scene, tmp_path / "out"))
    np.testing.assert_array_equal(again.points.xyz[-1], [1, 2, 3])


def test_find_scenes(make_scene_folder, tmp_path):
    b, a = make_scene_folder(name="set/b"), make_scene_folder(name="set/a")
    (tmp_path / "set" / "notes").mkdir()
    assert [scene.path for scene in find_scenes(tmp_path / "set")] == [a, b]
    assert [scene.path for scene in find_scenes(a)] == [a]
    with pytest.raises(SceneError, match=r"known format \(chronoscene: sparse/split.txt"):
        find_scenes(tmp_path / "set" / "notes")


def test_errors_name_what_was_looked_for(make_scene_folder, tmp_path):
    with pytest.raises(SceneError, match="expected a scene folder, found nothing; check the path"):
        read_scene(tmp_path / "nowhere")
    folder = make_scene_folder()
    with pytest.raises(SceneError, match="expected a scene folder, found a file"):
        detect(folder / "sparse/split.txt")
    with pytest.raises(ConfigError, match=r"expected one of .*chronoscene.*'chronoscnee'; did you"):
        read_scene(folder, format="chronoscnee")
    shutil.rmtree(folder / "sparse/0")
    with pytest.raises(SceneError, match="expected a COLMAP model"):
        read_scene(folder)
    (folder / "sparse/split.txt").unlink()
    with pytest.raises(SceneError, match=r"found images/, sparse/; give the folder of one scene"):
        read_scene(folder)


def test_split_file_that_is_not_text(make_scene_folder):
    folder = make_scene_folder()
    (folder / "sparse/split.txt").write_bytes(b"\xe9\x80 0\n")
    with pytest.raises(ChronoSceneError, match="found bytes that are not UTF-8; save it as UTF-8"):
        read_scene(folder)


def test_real_scenes(shared_data, tmp_path):
    plaza = read_scene(shared_data / "plaza")
    assert (len(plaza.frames), len(plaza.points), plaza.num_periods) == (108, 12_000, 3)
    assert len(plaza.select(split="test", period=2)) == 5
    assert plaza.frames[0].camera.params == (262.0, 262.0, 140.8, 110.4)
    town = read_scene(shared_data / "sheffield_scene")
    assert (len(town.frames), len(town.points), town.num_periods) == (80, 23_297, 2)
    again = read_scene(write(town, tmp_path / "out", image_source="none"))
    np.testing.assert_array_equal(again.points.track_xy, town.points.track_xy)
    json.dumps([f.name for f in again.frames])
