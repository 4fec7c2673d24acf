"""The guide to formats: its package works as it stands on the page."""

import csv
import re
import tomllib
from pathlib import Path

import numpy as np
import pytest
from installed import install

from chronoscene import formats
from chronoscene.errors import SceneError
from chronoscene.formats import detect, read_scene

PAGE = Path(__file__).parents[2] / "docs/guides/adding-a-format.md"
SHOWN = dict(
    re.findall(r"^`([\w.]+)`:\n\n```\w+\n(.*?)^```$", PAGE.read_text("utf-8"), re.M | re.S)
)
"""Content of each file that the page shows, by its name."""


@pytest.fixture
def table(make_scene_folder, tmp_path, monkeypatch):
    """The table of a folder in the format of the page, whose package is installed."""
    (entries,) = tomllib.loads(SHOWN["pyproject.toml"])["project"]["entry-points"].items()
    install(monkeypatch, tmp_path, {"camera_table": SHOWN["camera_table.py"]}, *entries)
    formats._plugins.cache_clear()
    scene = read_scene(make_scene_folder({"b.png": 1, "a.png": 0, "c.png": 1}))
    folder = tmp_path / "site"
    folder.mkdir()
    scene.images_root.rename(folder / "photos")
    keys = ("photo", "date", "width", "height", "fx", "fy", "cx", "cy", "cam_from_world")
    with (folder / "cameras.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(keys)
        for frame in reversed(scene.frames):
            camera, pose = frame.camera, " ".join(map(str, frame.cam_from_world.ravel().tolist()))
            when = f"202{frame.period}-05"
            writer.writerow([frame.name, when, camera.width, camera.height, *camera.params, pose])
    yield folder / "cameras.csv", scene
    monkeypatch.undo()
    formats._plugins.cache_clear()


def test_the_format_on_the_page_reads_a_scene(table):
    place, expected = table
    assert detect(place.parent).name == "camera-table"
    scene = read_scene(place.parent)
    assert [p.date for p in scene.periods] == ["2020-05", "2021-05"]
    for found, frame in zip(scene.frames, expected.frames, strict=True):
        assert (found.name, found.period, found.split) == (frame.name, frame.period, frame.split)
        np.testing.assert_array_equal(found.cam_from_world, frame.cam_from_world)
        np.testing.assert_array_equal(found.camera.K, frame.camera.K)
        assert scene.image_path(found).is_file()


def test_its_message_names_the_row(table):
    place, _ = table
    place.write_text(place.read_text().replace("a.png,2020-05,", "a.png,2020-05,x"))
    with pytest.raises(SceneError, match=r"cameras\.csv: expected numbers for a\.png, found .*; "):
        read_scene(place.parent)
