"""chronoscene undistort: the report, and errors on one line."""

import re
from functools import partial

import pytest
from command_line import invoke, refused

from chronoscene.convert import convert
from chronoscene.formats import read_scene

run = partial(invoke, "undistort")


@pytest.fixture
def distorted(make_scene_folder):
    """Its observations do not fit its camera, which matters to none of these tests."""
    folder = make_scene_folder(form="text")
    (folder / "sparse/0/cameras.txt").write_text("1 SIMPLE_RADIAL 64 48 50 30 25.5 -0.1\n")
    return folder


def test_reports_sizes(distorted, tmp_path):
    before = {p: p.read_bytes() for p in distorted.rglob("*") if p.is_file()}
    result = run(distorted, tmp_path / "out", "--threads", 2)
    assert result.exit_code == 0
    camera = read_scene(tmp_path / "out").frames[0].camera
    assert camera.model == "PINHOLE"
    line = f"camera 1: SIMPLE_RADIAL 64 x 48 -> PINHOLE {camera.width} x {camera.height}, f 50.00"
    assert line in result.stdout and "images resampled" in result.stdout
    assert {p: p.read_bytes() for p in distorted.rglob("*") if p.is_file()} == before


def test_center(make_scene_folder, tmp_path):
    result = run(make_scene_folder(), tmp_path / "out", "--center")
    assert "PINHOLE 60 x 44, f 50.00 52.00, c 30.00 22.00" in result.stdout


def test_says_what_was_dropped(make_scene_folder, tmp_path):
    folder = make_scene_folder(form="text")
    (folder / "sparse/0/cameras.txt").write_text("1 PINHOLE 64 48 50 52 10 10\n")
    result = run(folder, tmp_path / "out", "--center")
    assert "PINHOLE 20 x 20" in result.stdout
    assert re.search(
        r"dropped: \d+ observations? outside of the new images, and \d+ points? without any other",
        result.stdout,
    )


def test_names_what_is_left_out(make_scene_folder, tmp_path):
    convert(make_scene_folder(), tmp_path / "other", target="nerfstudio")
    (tmp_path / "other/images/a/0002.png").unlink()
    result = run(tmp_path / "other", tmp_path / "out")
    assert "note: 1 frame left out: no image" in result.stderr


def test_says_that_nothing_had_to_be_done(make_scene_folder, tmp_path):
    assert "images unchanged" in run(make_scene_folder(), tmp_path / "out").stdout


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["{tmp}/absent", "{tmp}/out"], "expected a scene folder, found nothing"),
        (["{scene}", "{scene}/out"], "OUT {scene}/out: expected a place outside the scene"),
        (["{scene}", "{tmp}"], "expected a new or empty folder"),
    ],
)
def test_errors_are_one_line(distorted, tmp_path, arguments, message):
    words = [a.format(tmp=tmp_path, scene=distorted) for a in arguments]
    error = refused("undistort", *words)
    assert message.format(scene=distorted) in error.splitlines()[-1]
    assert error.count("\n") <= 2  # after "read SCENE"


@pytest.mark.parametrize(("link", "is_symlink"), [("hard", False), ("sym", True)])
def test_links(make_scene_folder, tmp_path, link, is_symlink):
    folder, out = make_scene_folder(), tmp_path / "out"
    assert run(folder, out, "--link", link).exit_code == 0
    for frame in read_scene(out).frames:
        path = out / "images" / frame.name
        assert path.samefile(folder / "images" / frame.name) and path.is_symlink() == is_symlink


def test_records_of_a_registration_come_along(distorted, tmp_path):
    for name in ("georeference.json", "registration.json"):
        (distorted / name).write_text(f"{name} of register")
    result = run(distorted, tmp_path / "out")
    assert "not converted" not in result.stderr
    for name in ("georeference.json", "registration.json"):
        assert (tmp_path / "out" / name).read_text() == f"{name} of register"
