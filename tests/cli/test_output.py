"""Where commands write: an error names the option that the place came with."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner
from command_line import invoke
from PIL import Image

from chronoscene.cli import cli
from chronoscene.cli.output import check_file, check_place, emit, writing_to
from chronoscene.cli.report import results
from chronoscene.errors import ConfigError


@pytest.fixture
def places(make_scene_folder: Callable[[], Path], tmp_path: Path) -> Path:
    """A scene, photos, a file where a folder should be, and folders where files should be."""
    make_scene_folder()
    (tmp_path / "file").touch()
    for folder in ("folder", "figures/counts.png", "drawn/scene_points.svg", "pages/scene.html"):
        (tmp_path / folder).mkdir(parents=True)
    for period in "ab":
        (tmp_path / "photos" / period).mkdir(parents=True)
        Image.fromarray(np.zeros((480, 640, 3), np.uint8)).save(tmp_path / f"photos/{period}/0.jpg")
    return tmp_path


@pytest.mark.parametrize(
    ("words", "place"),
    [
        ("validate scene --out folder", "--out folder"),
        ("validate scene --sarif folder", "--sarif folder"),
        ("validate scene --html absent/page.html", "--html absent/page.html"),
        ("validate scene --fix file/new", "--fix file/new"),
        ("stats scene --out folder", "--out folder"),
        ("stats scene --figures file/new", "--figures file/new"),
        ("stats scene --figures figures", "--figures figures/counts.png"),
        ("stats scene --figures drawn --figure-format svg", "--figures drawn/scene_points.svg"),
        ("stats scene --pages file", "--pages file"),
        ("stats scene --pages pages", "--pages pages/scene.html"),
        ("split scene file/new", "OUT file/new"),
        ("split scene --scene-out file/new", "--scene-out file/new"),
        ("register photos file/new", "OUT file/new"),
        ("register photos new --work file/new", "--work file/new"),
        ("register photos new --work file", "--work file"),
        ("bench scene --method chronogs --out file/new", "--out file/new"),
    ],
)
def test_the_option_is_named(
    places: Path, monkeypatch: pytest.MonkeyPatch, words: str, place: str
) -> None:
    monkeypatch.chdir(places)
    result = CliRunner().invoke(cli, words.split())
    assert isinstance(result.exception, ConfigError), result.exception
    assert result.exception.place == place
    assert not (places / "new").exists()


@pytest.mark.parametrize("place", ["scene/x", "link/x", "figures/../scene/x", "linked/x"])
@pytest.mark.parametrize(
    "words",
    [
        "bench scene --method 3dgs --out",
        "convert scene",
        "register photos",
        "register photos new --work",
        "register photos --into scene",
        "register photos new --into scene --work",
        "split scene",
        "split scene --scene-out",
        "stats scene --out",
        "stats scene --figures",
        "stats scene --pages",
        "undistort scene",
        "validate scene --out",
        "validate scene --sarif",
        "validate scene --html",
        "validate scene --fix",
    ],
)
def test_nothing_is_written_into_a_dataset(
    places: Path, monkeypatch: pytest.MonkeyPatch, words: str, place: str
) -> None:
    """Not by its name, nor through a link to it, nor into a folder that it links to."""
    monkeypatch.chdir(places)
    (places / "scene/images").rename(places / "linked")
    (places / "scene/images").symlink_to(places / "linked")
    (places / "link").symlink_to("scene")
    if "register" in words and "--into" not in words:
        place = place.replace("scene", "photos").replace("linked", "photos/a")
        (places / "link").unlink()
        (places / "link").symlink_to("photos")
    before = sorted(places.rglob("*"))
    result = CliRunner().invoke(cli, [*words.split(), place])
    assert isinstance(result.exception, ConfigError), result.exception
    assert Path(result.exception.place.split()[-1]).resolve() == Path(place).resolve()
    assert result.exception.expected == "a place outside the scene"
    assert sorted(places.rglob("*")) == before


def test_a_table(places: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(results, "read_runs", lambda folders: ([], []))
    monkeypatch.setattr(results, "format_runs", lambda *_, **__: "no runs\n")
    with pytest.raises(ConfigError, match=r"^--out .*file/t\.csv: expected a file that can be"):
        invoke("table", places, "--out", places / "file/t.csv")


def test_what_is_no_error_of_the_disk_passes() -> None:
    with pytest.raises(ZeroDivisionError), writing_to("--out", Path("x")):
        _ = 1 / 0


def test_places_are_looked_at_and_left_alone(tmp_path: Path) -> None:
    check_place("--out", tmp_path)
    check_place("--out", tmp_path / "a/b/c")
    assert list(tmp_path.iterdir()) == []


def test_files_are_looked_at_and_left_alone(tmp_path: Path) -> None:
    check_file("--out", None)
    check_file("--out", tmp_path / "new")
    (tmp_path / "old").write_text("old")
    check_file("--out", tmp_path / "old")
    assert [p.name for p in tmp_path.iterdir()] == ["old"]
    assert (tmp_path / "old").read_text() == "old"
    for place in (tmp_path, tmp_path / "no/file", tmp_path / "old/file"):
        with pytest.raises(ConfigError, match=r"^--out .*: expected a file that can be written"):
            check_file("--out", place)


@pytest.mark.skipif(not Path("/dev/fd").is_dir(), reason="the system has no such folder")
def test_a_pipe_can_be_the_file() -> None:
    source, sink = os.pipe()
    check_file("--out", Path(f"/dev/fd/{sink}"))
    emit("text\n", Path(f"/dev/fd/{sink}"))
    os.close(sink)
    with open(source) as pipe:
        assert pipe.read() == "text\n"


def test_names_that_are_not_text_can_be_written(tmp_path: Path) -> None:
    emit("bad\udcff\n", tmp_path / "text")
    assert (tmp_path / "text").read_text(encoding="utf-8") == "bad\\udcff\n"


def test_written_text_has_no_colours(tmp_path: Path) -> None:
    emit("\x1b[31mred\x1b[0m\n", tmp_path / "text")
    assert (tmp_path / "text").read_text() == "red\n"
