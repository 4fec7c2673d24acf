"""The command register: messages and exit status; tests/registration has the work itself."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner, Result
from PIL import Image

from chronoscene.cli import cli as main
from chronoscene.cli.scenes import register
from chronoscene.errors import ChronoSceneError, ConfigError, RegistrationError, SceneError


def call(*arguments: str | Path) -> Result:
    return CliRunner().invoke(main, ["register", *map(str, arguments)])


def photos(folder: Path, count: int) -> Path:
    """Grey photos, all different."""
    folder.mkdir(parents=True)
    for i in range(count):
        Image.fromarray(np.full((480, 640, 3), 10 * i, np.uint8)).save(folder / f"{i}.jpg")
    return folder


@pytest.mark.parametrize("failed", [False, True])
def test_the_verdicts_decide_on_the_exit_status(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failed: bool
) -> None:
    def run(*inputs: Any, inspected: Any, **options: Any) -> Any:
        inspected(SimpleNamespace(failed=failed, summary="absolute position: pass\n"))
        return SimpleNamespace(
            route="joint",
            unit="metre",
            counts=lambda: [{"period": 1, "label": "b", "photos": 2, "registered": 1}],
            unregistered={"b/1.jpg": "no matches"},
            points=np.zeros((5, 3)),
            georeference=None,
        )

    photos(tmp_path / "in/a", 2)
    photos(tmp_path / "in/b", 2)
    monkeypatch.setattr(register, "run", run)
    done = call(tmp_path / "in", tmp_path / "out", "--crs", "EPSG:32632")
    assert done.exit_code == failed, done.output
    assert "period 1 (b): 1 of 2 photos registered" in done.output
    assert "b/1.jpg: no matches" in done.output and "absolute position" in done.output
    assert "no coordinates in EPSG:32632" in done.output


@pytest.mark.parametrize("count", [0, 1])
def test_too_few_photos_end_in_one_message(tmp_path: Path, count: int) -> None:
    photos(tmp_path / "in/a", count)
    done = call(tmp_path / "in", tmp_path / "out")
    assert isinstance(done.exception, ChronoSceneError), done.output
    assert not (tmp_path / "out").exists()


def test_the_scene_may_lie_beside_a_table_but_not_in_its_photos(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The photos, three folders deep, are those of the table, whatever else lies beside it."""
    monkeypatch.chdir(tmp_path)
    photos(Path("site/2016/a"), 2)
    photos(Path("disk/b"), 2)
    Path("new").symlink_to("disk")
    Path("dates.csv").write_text("image,period\nsite/2016/a/0.jpg,2016\nnew/b/1.jpg,2023\n")
    for place in ("site/out", "site/2016/a/out", "new/out", "disk/out"):
        assert isinstance(call("dates.csv", place).exception, ConfigError), place
        assert isinstance(call("dates.csv", "out", "--work", place).exception, ConfigError)
    seen: list[Any] = []

    def run(captures: Any, *inputs: Any, **options: Any) -> None:
        seen.extend(image.name for image in captures.images)
        raise RegistrationError("photos", expected="overlap", found="none", todo="add photos")

    monkeypatch.setattr(register, "run", run)
    assert isinstance(call("dates.csv", "out").exception, RegistrationError)
    assert seen == ["new/b/1.jpg", "site/2016/a/0.jpg"]
    Path("dates.csv").write_text("image,period\n0.jpg,2016\n")
    photos(Path("flat"), 1).joinpath("0.jpg").rename("0.jpg")
    assert isinstance(call("dates.csv", "out").exception, ConfigError)


@pytest.mark.parametrize(
    "places",
    [
        ["in/out"],
        ["out", "--work", "in/work"],
        ["out", "--into", "old", "--work", "old/work"],
        ["out", "--work", "."],
        ["../" * 9, "--overwrite"],
        ["out", "--into", "old", "--work", "a/.."],
    ],
)
def test_nothing_goes_into_the_photos_or_the_scene(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, places: list[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    photos(Path("in/a"), 3)
    Path("old").mkdir()
    before = sorted(Path().rglob("*"))
    done = call("in", *places)
    assert isinstance(done.exception, ConfigError), done.output
    assert sorted(Path().rglob("*")) == before


@pytest.mark.parametrize(
    ("given", "found"),
    [
        ("captures", "nothing there; check the path"),
        ("notes.txt", "another file; check the path"),
        ("empty", "no image files; copy the photos there"),
    ],
)
def test_captures_that_are_missing_are_what_the_message_is_about(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, given: str, found: str
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("notes.txt").write_text("mine")
    Path("empty").mkdir()
    done = call(given, "out")
    assert str(done.exception) == (
        f"{given}: expected a folder of photos, or a CSV table of images and their periods, "
        f"found {found}"
    )


def test_the_current_folder_is_refused_before_any_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos(tmp_path / "in/a", 3)
    (tmp_path / "out").mkdir()
    monkeypatch.chdir(tmp_path / "out")
    done = call(tmp_path / "in", ".")
    assert isinstance(done.exception, SceneError), done.output
    assert done.exception.found == "the current folder"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["in", "out"]


@pytest.mark.parametrize("end", [KeyboardInterrupt(), SystemExit(143), None])
def test_a_run_that_ends_early_says_what_the_work_folder_is_kept_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: BaseException | None
) -> None:
    """Ctrl-C, SIGTERM, or an error: here too few photos."""
    photos(tmp_path / "in/a", 1 if end is None else 3)

    def stop(*inputs: Any) -> None:
        raise end or AssertionError

    if end is not None:
        monkeypatch.setattr("chronoscene.registration.pipeline.find_matches", stop)
    done = call(tmp_path / "in", tmp_path / "out")
    assert done.exit_code != 0
    assert (
        f"note: {tmp_path / 'out.work'} was kept: run the same command again to continue from "
        "there, or delete the folder to start from scratch\n"
    ) in done.stderr
    assert (tmp_path / "out.work").is_dir()
    if end is None:
        assert isinstance(done.exception, RegistrationError)


@pytest.mark.parametrize(
    ("crs", "found"),
    [("EPSG:4326", "in degrees"), ("EPSG:32632+5773", "a geoid"), ("here", "'here'")],
)
def test_the_reference_system_is_checked_before_any_work(
    tmp_path: Path, crs: str, found: str
) -> None:
    done = call(photos(tmp_path / "in/a", 3).parent, tmp_path / "out", "--crs", crs)
    assert isinstance(done.exception, ConfigError), done.output
    assert done.exception.place == "--crs" and found in done.exception.found
    assert [p.name for p in tmp_path.iterdir()] == ["in"]


@pytest.mark.parametrize(
    ("text", "error", "found", "todo"),
    [
        # Coordinates of the output are called east and north.
        ("# crs: EPSG:5513\np,0.jpg,1,2,1040000,730000,300\n", ConfigError, "south and west", ""),
        (
            "point,image,x,y,X,Y,Z\np,,,,1,2,3\nq,,,,4,5,6\n",
            SceneError, "without a click", "chronoscene mark",
        ),
    ],
    ids=["axes", "no click"],
)  # fmt: skip
def test_control_is_checked_before_any_work(
    tmp_path: Path, text: str, error: type[ChronoSceneError], found: str, todo: str
) -> None:
    file = tmp_path / "gcp.csv"
    file.write_text(text)
    done = call(photos(tmp_path / "in/a", 3).parent, tmp_path / "out", "--tie-points", file)
    assert isinstance(done.exception, error), done.output
    assert done.exception.place == str(file) and found in done.exception.found
    assert todo in done.exception.todo
    assert sorted(p.name for p in tmp_path.iterdir()) == ["gcp.csv", "in"]


@pytest.mark.parametrize(
    ("option", "value", "given", "condition"),
    [
        ("--route", "separate", "--into", "with --into"),
        ("--calibration", "shared", "--into", "with --into"),
        ("--calibration", "per-period", "--cameras", "with --cameras"),
        ("--camera-model", "OPENCV", "--cameras", "with --cameras"),
        ("--max-image-size", "800", "--features", "with --features"),
        ("--max-features", "900", "--features", "with --features"),
        ("--exhaustive-limit", "9", "--matches", "with a file of --matches"),
        ("--tie-scale", "0.5", None, "without --tie-points"),
    ],
)
def test_options_without_an_effect_are_refused(
    tmp_path: Path, option: str, value: str, given: str | None, condition: str
) -> None:
    (tmp_path / "given").touch()
    other = [] if given is None else [given, tmp_path / "given"]
    done = call(photos(tmp_path / "in/a", 3), tmp_path / "out", option, value, *other)
    assert str(done.exception).startswith(f"{option}: expected no such option {condition}")
    assert not (tmp_path / "out.work").exists()


def test_features_that_are_not_there_are_refused_before_any_work(tmp_path: Path) -> None:
    done = call(photos(tmp_path / "in/a", 3), tmp_path / "out", "--features", "nope.h5")
    assert str(done.exception).startswith("--features: expected a file, or an installed plug-in (")
    assert not (tmp_path / "out.work").exists()


def test_a_click_that_may_mean_either_of_two_photos_is_refused_before_features(
    tmp_path: Path,
) -> None:
    """Later, one of them could have no pose, and the click would count for the other."""
    photos(tmp_path / "in/a", 2)
    for file in sorted(photos(tmp_path / "in/b", 2).iterdir()):
        Image.new("RGB", (640, 480), (200, 60 * int(file.stem), 0)).save(file)
    clicks = tmp_path / "clicks.csv"
    clicks.write_text("p,a/0.jpg,1,2\np,1.jpg,3,4\n")
    done = call(tmp_path / "in", tmp_path / "out", "--tie-points", clicks)
    assert isinstance(done.exception, SceneError), done.output
    assert done.exception.place == f"{clicks}:2"
    assert done.exception.found == "'1.jpg', which fits a/1.jpg and b/1.jpg"
    assert not (tmp_path / "out.work/features.db").exists()
