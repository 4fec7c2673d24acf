"""Formats of other packages: found by their entry point, detected, read and written."""

import pytest
from installed import install

from chronoscene import formats
from chronoscene.errors import ConfigError, SceneError
from chronoscene.formats import detect, format_names, read_scene, writable_formats
from chronoscene.harness.plan.plan import plan_runs
from chronoscene.harness.plan.settings import bench_settings

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
def install_format(tmp_path, monkeypatch):
    """Install a format by its entry point."""

    def add(source):
        module = f"format_of_{tmp_path.name}"
        entries = {"toy": module}
        install(monkeypatch, tmp_path, {module: source}, "chronoscene.formats", entries)
        formats._plugins.cache_clear()

    yield add
    monkeypatch.undo()
    formats._plugins.cache_clear()


def test_a_format_of_another_package(install_format, tmp_path, make_scene_folder):
    install_format(PLUG_IN)
    assert "toy" in format_names() and "toy" in writable_formats()
    scene = make_scene_folder({"a/0.png": 0, "b/0.png": 1})
    folder = tmp_path / "toys"
    folder.mkdir()
    (folder / "toy.txt").write_text(str(scene))
    assert detect(folder).name == "toy"
    assert read_scene(folder).num_periods == 2


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("import no_such_package", "which the package plug-in names, found ModuleNotFoundError: "),
        (PLUG_IN.replace("def read", "def load"), "found no read; correct the package"),
        (PLUG_IN.replace('"toy", "toy', '"toys", "toy'), "found NAME = 'toys'; correct"),
    ],
)
def test_a_broken_format_is_named(install_format, make_scene_folder, source, message):
    install_format(source)
    folder = make_scene_folder()
    with pytest.raises(ConfigError, match=f"^dataset format toy: expected .*{message}"):
        read_scene(folder)
    assert read_scene(folder, format="chronoscene").num_periods == 2
    assert "toy" not in writable_formats()


@pytest.mark.parametrize("function", ["matches", "read"])
def test_a_format_whose_code_fails_is_named(install_format, tmp_path, function):
    install_format(PLUG_IN.replace(f"def {function}(path):", f"def {function}(path):\n    1 / 0\n"))
    (tmp_path / "toy.txt").write_text("")
    message = r"the format toy can .* found ZeroDivisionError: division by zero \(.*\.py:\d+\); "
    with pytest.raises(SceneError, match=message):
        read_scene(tmp_path)


def test_runs_are_of_the_folder_of_a_format_that_points_elsewhere(
    install_format, tmp_path, make_scene_folder
):
    install_format(PLUG_IN)
    folder = tmp_path / "toys"
    folder.mkdir()
    images = {f"{name}/{i}.png": period for period, name in enumerate("ab") for i in range(3)}
    (folder / "toy.txt").write_text(str(make_scene_folder(images)))
    settings = bench_settings((folder,), ("3dgs",), tmp_path / "runs")
    (run,) = plan_runs(settings, lambda line: None).runs.values()
    assert run.job.read_scene().num_periods == 2
