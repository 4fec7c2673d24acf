"""The command mark: its notes and what it refuses; tests/registration has the page itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command_line import run_command
from PIL import Image


@pytest.fixture
def captures(tmp_path: Path) -> Path:
    """Return a folder of two grey photos."""
    folder = tmp_path / "in"
    folder.mkdir()
    for i in range(2):
        Image.fromarray(np.full((480, 640, 3), 10 * i, np.uint8)).save(folder / f"{i}.jpg")
    return folder


@pytest.mark.parametrize(("option", "value"), [("--tie-scale", "2"), ("--crs", "EPSG:32632")])
def test_options_of_points_that_are_not_given_are_refused(
    tmp_path: Path, captures: Path, option: str, value: str
) -> None:
    done = run_command("mark", captures, tmp_path / "page.html", option, value)
    assert f"{option}: expected no such option without --tie-points" in done.stderr
    assert not (tmp_path / "page.html").exists()


def test_photos_and_clicks_that_the_page_does_not_show_are_named(
    tmp_path: Path, captures: Path
) -> None:
    (captures / "2.jpg").write_bytes(b"no photo")
    (captures / "3.dng").touch()
    clicks = tmp_path / "points.csv"
    clicks.write_text("p,0.jpg,12,34\np,9.jpg,56,78\n", "utf-8")
    done = run_command("mark", captures, tmp_path / "page.html", "--tie-points", clicks)
    assert done.exit_code == 0
    assert "note: 2.jpg is not on the page: cannot be decoded" in done.stderr
    assert "note: 1 photo in formats that are not read (.dng), such as 3.dng" in done.stderr
    assert "note: 1 click in photos that are not in CAPTURES, such as '9.jpg'" in done.stderr
    assert "page.html: 2 photos" in done.stdout


def test_a_model_of_other_photos_is_refused(tmp_path: Path, captures: Path) -> None:
    (tmp_path / "cameras.txt").write_text("1 SIMPLE_PINHOLE 640 480 500 320 240\n", "utf-8")
    (tmp_path / "images.txt").write_text("1 1 0 0 0 0 0 0 1 other/0.jpg\n\n", "utf-8")
    (tmp_path / "points3D.txt").touch()
    done = run_command("mark", captures, tmp_path / "page.html", "--model", tmp_path)
    assert "expected images such as 0.jpg, found other/0.jpg" in done.stderr
    assert not (tmp_path / "page.html").exists()
