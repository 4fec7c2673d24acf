"""Conversions: where they may go, what they say, and that nothing is touched or half done."""

import dataclasses
import hashlib
import os
from pathlib import Path

import numpy as np
import pytest

from chronoscene.convert import convert, losses, obstacles
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import load_format, read_scene, writable_formats
from chronoscene.scene import Camera, Period, Points, WorldFrame
from chronoscene.scene.splits import split_hash


def snapshot(folder):
    return {
        str(p.relative_to(folder)): hashlib.sha256(p.read_bytes()).hexdigest()
        for p in folder.rglob("*")
        if p.is_file()
    }


def test_there_and_back(make_scene_folder, tmp_path):
    """Through both other formats: images, periods, split and poses are the same."""
    folder = make_scene_folder(tests=["a/0002.png", "b/0003.png"])
    before, scene = snapshot(folder), read_scene(folder)
    convert(folder, tmp_path / "studio", target="nerfstudio")
    convert(tmp_path / "studio", tmp_path / "plain", target="colmap-folders")
    convert(tmp_path / "plain", tmp_path / "back")
    again = read_scene(tmp_path / "back")
    assert [f.name for f in again.frames] == [f"{f.period}/{f.name}" for f in scene.frames]
    assert [(f.period, f.split) for f in again.frames] == [
        (f.period, f.split) for f in scene.frames
    ]
    for a, b in zip(scene.frames, again.frames, strict=True):
        np.testing.assert_allclose(a.cam_from_world, b.cam_from_world, atol=1e-13)
        assert again.image_path(b).read_bytes() == scene.image_path(a).read_bytes()
    np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)
    assert snapshot(folder) == before


def test_masks_follow_their_images(make_scene_folder, tmp_path):
    """Through the other formats, where images get other names; a stray mask stays behind."""
    folder = make_scene_folder()
    scene = read_scene(folder)
    (folder / "masks/a").mkdir(parents=True)
    (folder / "masks/a/0002.png.png").write_bytes(b"a mask")
    (folder / "masks/stray.png").write_bytes(b"of no image")
    assert read_scene(folder).masks == {"a/0002.png": folder / "masks/a/0002.png.png"}
    assert "a/0002.png" in {f.name for f in scene.frames}
    assert convert(folder, tmp_path / "studio", target="nerfstudio").warnings
    convert(tmp_path / "studio", tmp_path / "plain", target="colmap-folders")
    done = convert(tmp_path / "plain", tmp_path / "days", target="cl-splats")
    assert "cl-splats cannot store masks, which its loader does not read" in done.warnings
    again = read_scene(tmp_path / "days")
    ((name, path),) = again.masks.items()
    assert name.endswith("a_0002.png") and path.read_bytes() == b"a mask"
    assert len(list(tmp_path.glob("plain/masks/**/*.png"))) == 1


@pytest.mark.parametrize("target", writable_formats())
def test_labels_dates_and_world_are_kept(make_scene_folder, tmp_path, target):
    folder = make_scene_folder()
    (folder / "sparse/periods.json").write_text(
        '[{"id": 0, "label": "vorher", "date": "2016-09"}, {"id": 1, "label": "nachher"}]'
    )
    (folder / "sparse/world.json").write_text('{"unit": "metre", "offset": [4e5, 5e6, 0.1]}')
    convert(folder, tmp_path / target, target=target)
    convert(tmp_path / target, tmp_path / "back", source_format=target)
    again = read_scene(tmp_path / "back")
    assert again.periods == (Period(0, "vorher", "2016-09"), Period(1, "nachher"))
    assert again.world == WorldFrame("metre", None, (4e5, 5e6, 0.1))
    if target in ("chronoscene", "nerfstudio"):  # which keep the names of the images
        assert split_hash(again) == split_hash(read_scene(folder))


def test_periods_of_another_rule_get_no_labels_of_folders(make_scene_folder, tmp_path):
    folder = make_scene_folder({"a/0.png": 0, "b/1.png": 1})
    (folder / "sparse/periods.json").write_text(
        '[{"id": 0, "label": "x"}, {"id": 1, "label": "y"}]'
    )
    convert(folder, tmp_path / "plain", target="colmap-folders")
    table = tmp_path / "table.csv"
    table.write_text("file,period\nx/a/0.png,first\ny/b/1.png,second\n")
    again = read_scene(tmp_path / "plain", period_by=f"table:{table}")
    assert [p.label for p in again.periods] == ["first", "second"]


def test_equal_file_names_stay_apart(make_scene_folder, tmp_path):
    folder = make_scene_folder({"a/1.png": 0, "b/1.png": 1, "1.png": 1})
    scene = read_scene(folder)
    convert(folder, tmp_path / "out", target="colmap-folders")
    again = read_scene(tmp_path / "out")
    names = [f.name for f in again.frames]
    assert sorted(names) == ["0/a/1.png", "1/1.png", "1/b/1.png"]
    contents = {again.image_path(f).read_bytes() for f in again.frames}
    assert contents == {scene.image_path(f).read_bytes() for f in scene.frames}


@pytest.mark.parametrize("out", ["", "new", "images/new", "../scene/new"])
def test_never_into_the_source(make_scene_folder, out):
    folder = make_scene_folder()
    before = snapshot(folder)
    with pytest.raises(ConfigError, match="a place outside the scene"):
        convert(folder, folder / out)
    assert snapshot(folder) == before


def test_never_into_the_source_through_a_link(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    (tmp_path / "link").symlink_to(folder)
    with pytest.raises(ConfigError, match="a place outside the scene"):
        convert(folder, tmp_path / "link" / "new")


def test_never_into_what_the_source_links_to(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    (folder / "images").rename(tmp_path / "photos")
    (folder / "images").symlink_to(tmp_path / "photos")
    with pytest.raises(ConfigError, match=r"found one in .*/scene/images; choose another"):
        convert(folder, tmp_path / "photos/new")
    assert len(convert(folder, tmp_path / "new").scene.frames) == 4


@pytest.mark.parametrize("target", writable_formats())
def test_a_folder_in_use_is_left_alone(make_scene_folder, tmp_path, target):
    out = tmp_path / "out"
    out.mkdir()
    (out / "thesis.txt").write_text("all of it")
    with pytest.raises(
        SceneError, match="expected a new or empty folder, found one that is not empty"
    ):
        convert(make_scene_folder(), out, target=target)
    assert snapshot(out) == {"thesis.txt": hashlib.sha256(b"all of it").hexdigest()}


@pytest.mark.parametrize("target", writable_formats())
def test_nothing_is_left_of_a_failure(make_scene_folder, tmp_path, target):
    folder = make_scene_folder()
    (folder / "images/b/0003.png").unlink()
    with pytest.raises(SceneError, match=r"0003\.png: expected an image, found nothing"):
        convert(folder, tmp_path / "target/out", target=target)
    assert not (tmp_path / "target").exists()


@pytest.mark.skipif(getattr(os, "geteuid", int)() == 0, reason="root may write everywhere")
def test_a_place_without_permission(make_scene_folder, tmp_path):
    (tmp_path / "locked").mkdir(mode=0o500)
    with pytest.raises(SceneError, match="expected a place that can be written to"):
        convert(make_scene_folder(), tmp_path / "locked/out")


def test_below_a_file(make_scene_folder, tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(SceneError, match="expected a place that can be written to, found"):
        convert(make_scene_folder(), tmp_path / "file/out")


@pytest.mark.parametrize("target", writable_formats())
def test_links(make_scene_folder, tmp_path, target):
    folder = make_scene_folder({"0/a.png": 0, "1/a.png": 1})
    for kind in ("link", "symlink", "copy"):
        convert(folder, tmp_path / kind, target=target, image_source=kind)
        again = read_scene(tmp_path / kind, format=target)
        image, source = again.image_path(again.frames[0]), folder / "images/0/a.png"
        assert image.read_bytes() == source.read_bytes()
        assert image.is_symlink() == (kind == "symlink")
        assert os.path.samefile(image, source) == (kind != "copy")


def test_progress_counts_images(make_scene_folder, tmp_path):
    for target in writable_formats():
        seen = []
        convert(
            make_scene_folder(name=f"s-{target}"),
            tmp_path / target,
            target=target,
            progress=lambda done, total, seen=seen: seen.append((done, total)),
        )
        assert seen == [(i, 4) for i in range(1, 5)]


def test_unknown_target_and_grouping(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    with pytest.raises(ConfigError, match="nerfstudio, neusc, wat, found 'matrixcity'"):
        convert(folder, tmp_path / "out", target="matrixcity")
    with pytest.raises(ConfigError, match="which defines its own periods"):
        convert(folder, tmp_path / "out", period_by="year")


def test_losses(make_scene_folder):
    scene = read_scene(make_scene_folder())
    assert losses(scene, "chronoscene") == []
    (names,) = losses(scene, "colmap-folders")
    assert names.endswith("the image names, to which the period is added")
    assert losses(scene, "nerfstudio") == [
        "nerfstudio cannot store the observations of points, their ids and errors"
    ]


def test_nothing_is_lost_where_folders_are_the_periods(make_scene_folder):
    scene = read_scene(make_scene_folder({"2016/a.png": 0, "2023/a.png": 1}))
    labelled = dataclasses.replace(scene, periods=(Period(0, "2016"), Period(1, "2023")))
    assert losses(labelled, "colmap-folders") == []


def test_images_that_are_not_registered_are_remarked_upon(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    (folder / "images/a/late.JPG").write_bytes(b"x")
    (folder / "images/notes.txt").write_text("")
    done = convert(folder, tmp_path / "out")
    assert done.warnings == (
        "1 image files in images/ are not part of the scene and were not converted",
    )


def test_other_files_are_remarked_upon(make_scene_folder, tmp_path):
    folder = make_scene_folder()
    (folder / "gt").mkdir()
    (folder / "README").write_text("")
    done = convert(folder, tmp_path / "out")
    assert done.warnings == ("not part of the format, and not converted: README, gt/",)


def test_obstacles(make_scene_folder):
    scene = read_scene(make_scene_folder())
    assert obstacles(scene) == []
    odd = Camera(1, "OPENCV", 64, 48, (50, 50, 32, 24, 0.1, 0, 0, 0))
    frames = [dataclasses.replace(f, camera=odd, split="train") for f in scene.frames]
    bad = dataclasses.replace(scene.with_frames(frames), points=Points.empty())
    distortion, points, tests = obstacles(bad)
    assert "OPENCV" in distortion and "chronoscene undistort" in distortion
    assert "no points" in points and "chronoscene split" in tests


@pytest.mark.parametrize("target", ["cl-splats", "nerfstudio", "neusc", "wat"])
def test_panoramas_cannot_be_undistorted(make_scene_folder, tmp_path, target):
    scene = read_scene(make_scene_folder())
    camera = Camera(1, "EQUIRECTANGULAR", 64, 48, (64, 48))
    scene = scene.with_frames([dataclasses.replace(f, camera=camera) for f in scene.frames])
    assert [found.rpartition(": ")[2] for found in obstacles(scene)] == [
        "render perspective views of the panoramas, and register those"
    ]
    with pytest.raises(SceneError, match="render perspective views of the panoramas"):
        load_format(target).write(scene, tmp_path / "out")


@pytest.mark.parametrize("source", ["copy", "link", "symlink"])
def test_two_names_of_one_file_are_refused(make_scene_folder, tmp_path, source):
    scene = read_scene(make_scene_folder({"a/0.png": 0, "b/0.png": 1}))
    first, second = scene.frames
    twice = dataclasses.replace(scene, frames=(first, dataclasses.replace(second, name="a//0.png")))
    for name in ("chronoscene", "nerfstudio"):
        with pytest.raises(SceneError, match="expected a separate file for each image"):
            load_format(name).write(twice, tmp_path / "out", image_source=source)
    assert not (tmp_path / "out").exists()


def test_the_working_folder_is_refused(make_scene_folder, tmp_path, monkeypatch):
    folder, empty = make_scene_folder(), tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    with pytest.raises(SceneError, match="expected a folder other than the current one"):
        convert(folder, Path())
    assert list(empty.iterdir()) == []


def test_a_link_to_an_empty_folder_may_be_written_to(make_scene_folder, tmp_path):
    (tmp_path / "disk").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "disk")
    convert(make_scene_folder(), tmp_path / "link")
    assert (tmp_path / "link").is_symlink()
    assert len(read_scene(tmp_path / "disk").frames) == 4


def test_a_scene_without_training_images_is_said(make_scene_folder):
    (said,) = obstacles(read_scene(make_scene_folder({"a.png": 0, "b.png": 1})))
    assert said.startswith("there are no training images; chronoscene split")
