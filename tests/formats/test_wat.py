"""WAT, and how it is told apart from plain COLMAP in the same layout."""

import dataclasses
from pathlib import Path

import pytest

from chronoscene.colmap.binary import read_cameras
from chronoscene.errors import SceneError
from chronoscene.formats import detect, read_scene, wat
from chronoscene.scene import Camera, Period


def names(tasks, count=9):
    return [f"{task}/{i:02d}.png" for task in tasks for i in range(count)]


def test_tasks_in_order_of_first_appearance(colmap_folder):
    scene = read_scene(colmap_folder(names(["b", "a", "c"]), name="spa"))
    assert scene.format == "wat"
    assert [p.label for p in scene.periods] == ["a", "b", "c"]
    tests = [f.name for f in scene.select(split="test")]
    assert tests == [f"{task}/{i}.png" for task in "abc" for i in ("00", "08")]


def test_every_image_keeps_its_own_camera(colmap_folder):
    folder = colmap_folder(names(["a", "b"], 2), name="car_resized", form="text")
    cameras = folder / "sparse/0/cameras.txt"
    images = folder / "sparse/0/images.txt"
    for file in ("rigs.txt", "frames.txt"):
        (folder / "sparse/0" / file).unlink()
    cameras.write_text(cameras.read_text() + "2 SIMPLE_RADIAL 64 48 55 32 24 -0.1\n")
    images.write_text(images.read_text().replace(" 1 b/01.png", " 2 b/01.png"))
    models = {f.name: f.camera.model for f in read_scene(folder).frames}
    assert models["b/01.png"] == "SIMPLE_RADIAL" and models["b/00.png"] == "PINHOLE"


def test_same_layout_with_another_name_is_plain_and_reads_the_same(colmap_folder):
    files = names(["t1", "t2"])
    a = read_scene(colmap_folder(files, name="kitchen"))
    b = read_scene(colmap_folder(files, name="my_kitchen"))
    assert (a.format, b.format) == ("wat", "colmap-folders")
    assert a.periods == b.periods
    assert [(f.name, f.period, f.split) for f in a.frames] == [
        (f.name, f.period, f.split) for f in b.frames
    ]


def test_where_the_readings_differ_the_format_must_be_named(colmap_folder):
    folder = colmap_folder(names(["t2", "t10"], 1), name="street")
    with pytest.raises(SceneError, match=r"marks of colmap-folders and wat; .*--dataset-format"):
        detect(folder)
    orders = {
        name: [p.label for p in read_scene(folder, format=name).periods]
        for name in ("wat", "colmap-folders")
    }
    assert orders == {"wat": ["t10", "t2"], "colmap-folders": ["t2", "t10"]}


def test_a_project_that_only_has_the_name_is_plain(colmap_folder):
    """A list of test images counts, and folders within those of the periods are no periods."""
    folder = colmap_folder(names(["t1", "t2"]), name="street")
    (folder / "sparse/0/test.txt").write_text("t1/01.png\n")
    scene = read_scene(folder)
    assert scene.format == "colmap-folders"
    assert [f.name for f in scene.select(split="test")] == ["t1/01.png"]
    deep = read_scene(colmap_folder(names(["t1/left", "t1/right", "t2/left"]), name="car"))
    assert (deep.format, [p.label for p in deep.periods]) == ("colmap-folders", ["t1", "t2"])
    assert read_scene(folder, format="wat").format == "wat"


def test_images_outside_of_tasks_are_refused(colmap_folder):
    with pytest.raises(SceneError, match=r"every image in the folder of its task, found 'a.png'"):
        read_scene(colmap_folder(["a.png", "b/c.png"], name="mac"), format="wat")


def as_clnerf_reads(folder):
    """Task and split of each image, and the record of camera 1, as its loader is described."""
    cameras = {c.camera_id: c for c in read_cameras(folder / "sparse/0/cameras.bin")}
    paths = sorted(str(p) for p in (folder / "images").rglob("*") if not p.is_dir())
    tasks = list(dict.fromkeys(path.rsplit("/", 2)[1] for path in paths))
    of_task = {task: [p for p in paths if p.rsplit("/", 2)[1] == task] for task in tasks}
    found = {
        Path(path): (tasks.index(task), "train" if i % 8 else "test")
        for task, members in of_task.items()
        for i, path in enumerate(members)
    }
    return found, cameras[1]


@pytest.mark.parametrize(
    "labels", [("t2", "t10"), ("a", "b"), ("new", "after 9/2016"), ("t", "t-x"), ("1", "1")]
)
def test_what_is_written_is_read_by_clnerf_as_meant(make_scene_folder, tmp_path, labels):
    names = {f"{'ab'[p]}/{'cd'[i % 2]}/{i:02d}.png": p for p in (0, 1) for i in range(10)}
    scene = read_scene(make_scene_folder(names))
    periods = tuple(Period(i, label) for i, label in enumerate(labels))
    camera = dataclasses.replace(scene.frames[0].camera, camera_id=7)
    frames = [dataclasses.replace(f, camera=camera) for f in scene.frames]
    scene = dataclasses.replace(scene.with_frames(frames), periods=periods)
    out = wat.write(scene, tmp_path / "out", image_source="symlink")
    found, read = as_clnerf_reads(out)
    sources = {path.resolve(): path for path in found}
    for frame in scene.frames:
        task, _ = found[sources[scene.image_path(frame).resolve()]]
        assert task == frame.period
    assert (read.width, read.height, read.params) == (64, 48, camera.params)
    ours = read_scene(out, format="wat")
    for frame in ours.frames:
        assert found[ours.image_path(frame)] == (frame.period, frame.split)


def test_cameras_that_clnerf_would_mix_up_are_refused(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder())
    first, *others = scene.frames
    other = Camera(2, "PINHOLE", 64, 48, (51, 52, 30, 25.5))
    two = scene.with_frames([dataclasses.replace(first, camera=other), *others])
    with pytest.raises(SceneError, match=r"one camera for all images.*found 2 cameras"):
        wat.write(two, tmp_path / "out")
    odd = Camera(1, "OPENCV_FISHEYE", 64, 48, (50, 52, 30, 25.5, 0.1, 0, 0, 0))
    one = scene.with_frames([dataclasses.replace(f, camera=odd) for f in scene.frames])
    with pytest.raises(SceneError, match="found OPENCV_FISHEYE"):
        wat.write(one, tmp_path / "out")
    simple = Camera(3, "SIMPLE_PINHOLE", 64, 48, (50, 30, 25.5))
    one = scene.with_frames([dataclasses.replace(f, camera=simple) for f in scene.frames])
    again = read_scene(wat.write(one, tmp_path / "out"), format="wat")
    assert again.frames[0].camera == Camera(1, "PINHOLE", 64, 48, (50, 50, 30, 25.5))


def test_what_clnerf_does_otherwise_is_said(make_scene_folder):
    scene = read_scene(make_scene_folder({"a/0.png": 0, "a/1.png": 0, "b/0.png": 1}, tests=["a/1"]))
    bent = Camera(1, "OPENCV", 64, 48, (50, 52, 30, 25.5, 0.1, 0, 0, 0))
    scene = scene.with_frames([dataclasses.replace(f, camera=bent) for f in scene.frames])
    lost = " ".join(wat.losses(scene))
    assert "the split, because its loader takes images 0, 8, 16" in lost
    assert "distortion, which its loader ignores" in lost
    periods = (Period(0, "a"), Period(1, "b"))
    named = dataclasses.replace(scene, periods=periods)
    assert "equal file names in several tasks" in " ".join(wat.losses(named))


def test_names_that_would_become_one_are_refused(make_scene_folder, tmp_path):
    scene = read_scene(make_scene_folder({"a/x/0.png": 0, "a/x_0.png": 0, "b/0.png": 1}))
    with pytest.raises(SceneError, match="distinct image names, found '"):
        wat.write(scene, tmp_path / "out", image_source="none")
