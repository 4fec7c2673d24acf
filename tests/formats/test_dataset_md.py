"""The samples in DATASET.md are one scene; what the page says about it holds."""

import re
from pathlib import Path

import numpy as np
import pytest

from chronoscene.formats import FORMATS, read_scene, writable_formats
from chronoscene.scene import Period, Scene, WorldFrame
from chronoscene.statistics.counts import assign_points

PAGE = Path(__file__).parents[2] / "DATASET.md"


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The samples, written to the files that they name."""
    root = tmp_path_factory.mktemp("documented")
    samples = re.findall(r"^```\w+ file=(\S+)\n(.*?)^```", PAGE.read_text("utf-8"), re.M | re.S)
    for name, text in samples:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        (root / name).write_text(text, encoding="utf-8")
    return root


@pytest.fixture(scope="module")
def scene(folder) -> Scene:
    return read_scene(folder)


def test_every_file_of_the_format_has_a_sample(folder):
    names = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    model = {f"sparse/0/{stem}.txt" for stem in ("cameras", "images", "points3D")}
    assert names == model | {
        *("sparse/split.txt", "sparse/0/test.txt", "sparse/periods.json", "sparse/world.json")
    }


def test_frames(scene):
    assert [(f.name, f.period, f.split) for f in scene.frames] == [
        ("2016/IMG_0001.jpg", 0, "train"),
        ("2016/IMG_0002.jpg", 0, "test"),
        ("DJI_0001.1.jpg", 1, "test"),
        ("DJI_0002.1.jpg", 1, "train"),
        ("old_town_3.jpg", 0, "train"),
    ]
    assert scene.frames[0].camera.params == (1210.5, 1208.25, 790.5, 612.75)


def test_periods_and_world(scene):
    assert scene.periods == (
        Period(0, "before", "2016-09"),
        Period(1, "after the works", "2023-04-17"),
    )
    assert scene.world == WorldFrame("metre", "EPSG:32650", (442000.0, 4427000.0, 50.0))


def test_the_sample_model_is_consistent(scene):
    """Its observations are where its cameras see its points."""
    lengths = np.diff(scene.points.track_start)
    for xyz, frame, xy in zip(
        np.repeat(scene.points.xyz, lengths, axis=0),
        scene.points.track_frame,
        scene.points.track_xy,
        strict=True,
    ):
        pose, K = scene.frames[frame].cam_from_world, scene.frames[frame].camera.K
        pixel = K @ (pose[:3, :3] @ xyz + pose[:3, 3])
        np.testing.assert_allclose(pixel[:2] / pixel[2], xy, atol=1e-9)


def test_counting_rule_on_the_sample(scene):
    assert assign_points(scene.count_views()).tolist() == [0, 1]


def test_default_split_as_stated(folder, tmp_path):
    for path in folder.rglob("*"):
        target = tmp_path / path.relative_to(folder)
        if path.is_dir():
            target.mkdir(exist_ok=True)
        elif path.name != "test.txt":
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(path.read_bytes())
    tests = [f.name for f in read_scene(tmp_path).frames if f.split == "test"]
    assert tests == ["2016/IMG_0001.jpg", "DJI_0001.1.jpg"]


def test_every_format_has_a_row():
    """The section on other formats lists them all, and says rightly which can be written."""
    section = PAGE.read_text("utf-8").split("## Other formats")[1].split("\n## ")[0]
    rows = dict(re.findall(r"^\| `([\w-]+)`.*\| (yes|no) \|$", section, re.M))
    assert rows.keys() == FORMATS.keys()
    assert {name for name, written in rows.items() if written == "yes"} == {*writable_formats()}
