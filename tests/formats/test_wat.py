"""WAT, and how it is told apart from plain COLMAP in the same layout."""

import pytest

from chronoscene.errors import SceneError
from chronoscene.formats import detect_format, read_scene


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
    with pytest.raises(SceneError, match=r"marks of colmap-folders and wat; .*--format"):
        detect_format(folder)
    orders = {
        name: [p.label for p in read_scene(folder, format=name).periods]
        for name in ("wat", "colmap-folders")
    }
    assert orders == {"wat": ["t10", "t2"], "colmap-folders": ["t2", "t10"]}


def test_images_outside_of_tasks_are_refused(colmap_folder):
    with pytest.raises(SceneError, match=r"every image in the folder of its task, found 'a.png'"):
        read_scene(colmap_folder(["a.png", "b/c.png"], name="mac"), format="wat")
