"""``chronoscene synth`` on the command line."""

from __future__ import annotations

from pathlib import Path

import pytest
from command_line import invoke

from chronoscene.errors import ChronoSceneError, ConfigError, SceneError
from chronoscene.formats import chronoscene as scene_format


def call(*args: str) -> object:
    return invoke("synth", *args).exit_code


def test_makes_the_scene_that_the_options_ask_for(tmp_path: Path) -> None:
    out = tmp_path / "place"
    options = "--preset tiny --periods 1 --size 40x30 --views 4 --points 60 --seed 5 --off-centre"
    assert call(str(out), *options.split()) == 0
    scene = scene_format.read(out)
    camera = scene.frames[0].camera
    assert scene.num_periods == 1  # two without the option
    assert (camera.width, camera.height) == (40, 30)
    assert camera.params[2] != 20
    assert 0 < len(scene.points) <= 60


def test_says_what_it_made(tmp_path: Path) -> None:
    out = tmp_path / "[bold] place"
    options = ["--preset", "tiny", "--periods", "1", "--size", "16x16", "--views", "4"]
    result = invoke("synth", out, *options)
    assert result.stderr.splitlines()[-1] == f"{out}: 1 period, seed 0"


@pytest.mark.parametrize(
    ("option", "place"),
    [
        (["--size", "0x10"], "--size: expected a value from 16 to 8192, found 0"),
        (["--preset", "huge"], "--preset"),
        (["--periods", "0"], "--periods"),
        (["--kind", "orbital"], "--kind"),
        (["--views", "1"], "--views"),
        (["--seed", "-2"], "--seed"),
        (["--noise", "-1"], "--noise"),
    ],
)
def test_bad_options(tmp_path: Path, option: list[str], place: str) -> None:
    with pytest.raises(ConfigError, match=place):
        call(str(tmp_path / "out"), *option)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("size", ["320", "-4x10"])
def test_a_size_that_is_none_is_a_usage_error(tmp_path: Path, size: str) -> None:
    result = invoke("synth", tmp_path / "out", "--size", size)
    assert result.exit_code == 2
    assert "'--size': expected WIDTHxHEIGHT, such as 320x240" in result.output
    assert not (tmp_path / "out").exists()


def test_a_folder_in_use(tmp_path: Path) -> None:
    (tmp_path / "a.txt").touch()
    with pytest.raises(SceneError, match="choose another folder"):
        call(str(tmp_path), "--preset", "tiny")


def test_a_place_that_is_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ChronoSceneError):
        call(str(tmp_path / "file" / "scene"), "--preset", "tiny")
