"""Formats of other packages: found by their entry point, detected, read and written."""

import pytest
from installed import install

from chronoscene import formats
from chronoscene.formats import detect, format_names, read_scene, writable_formats

PLUG_IN = """
from pathlib import Path
from chronoscene.formats import chronoscene

NAME, MARKS = "toy", "toy.txt"

def matches(path):
    return (path / "toy.txt").is_file()

def read(path):
    return chronoscene.read(Path((path / "toy.txt").read_text()))

def losses(scene):
    return []

def write(scene, out, **options):
    out.mkdir()
    (out / "toy.txt").write_text(str(scene.root))
    return out
"""


@pytest.fixture
def toy(tmp_path, monkeypatch):
    install(
        monkeypatch, tmp_path, {"toy_format": PLUG_IN}, "chronoscene.formats", {"toy": "toy_format"}
    )
    formats.installed_formats.cache_clear()
    yield
    monkeypatch.undo()
    formats.installed_formats.cache_clear()


def test_a_format_of_another_package(toy, tmp_path, make_scene_folder):
    assert "toy" in format_names() and "toy" in writable_formats()
    scene = make_scene_folder({"a/0.png": 0, "b/0.png": 1})
    folder = tmp_path / "toys"
    folder.mkdir()
    (folder / "toy.txt").write_text(str(scene))
    assert detect(folder).name == "toy"
    assert read_scene(folder).num_periods == 2
