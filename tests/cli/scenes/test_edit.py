"""``chronoscene edit`` and ``chronoscene triangulate`` on the command line."""

import pytest
from command_line import invoke, refused

from chronoscene.cli.scenes import triangulate
from chronoscene.formats import chronoscene as our_format
from chronoscene.formats import read_scene
from chronoscene.registration.triangulation import Triangulated


def test_says_what_is_left(make_scene_folder, tmp_path):
    periods = {f"{p}/{i}.png": j for j, p in enumerate("ab") for i in range(3)}
    folder = make_scene_folder(periods, tests=["a/0.png"])
    result = invoke(
        "edit", folder, tmp_path / "out", "--drop", "b/0.png", "--keep-period", "1",
        "--rename", "1=after", "--crop=-100,-100,-100,100,100,100", "--link", "hard",
    )  # fmt: skip
    assert result.exit_code == 0
    assert "2 images, 1 camera, 30 points, 1 period" in result.stdout
    assert "period 0 (after): 2 train, 0 test\n4 images left out\n" in result.stdout
    assert "points left out: none" in result.stdout
    assert "there are no test images" in result.stderr
    (frame, _) = read_scene(tmp_path / "out").frames
    assert (tmp_path / "out/images" / frame.name).samefile(folder / "images" / frame.name)


def test_labels_that_are_numbers_stand_once(make_scene_folder, tmp_path):
    folder = make_scene_folder({f"{i}.png": i // 2 for i in range(4)}, tests=["0.png", "1.png"])
    result = invoke("edit", folder, tmp_path / "out", "--drop", "3.png")
    assert "note: period 0 has no training images" in result.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give something to do"),
        (["--crop", "1,2,3"], "--crop: expected six numbers"),
        (["--crop", "1,1,1,0,2,2"], "--crop: expected six numbers"),
        (["--rename", "a"], "--rename: expected KEY=VALUE, found 'a'"),
        (["--drop", "a/002.png"], "did you mean 'a/0002.png'?"),
    ],
)
def test_errors(make_scene_folder, tmp_path, arguments, message):
    error = refused("edit", make_scene_folder(), tmp_path / "out", *arguments)
    assert message in error.splitlines()[-1]
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("command", [("edit", "--drop", "a/0001.png"), ("triangulate",)])
def test_never_into_the_scene(make_scene_folder, command):
    folder = make_scene_folder()
    name, *options = command
    error = refused(name, folder, f"{folder}/out", *options)
    assert f"OUT {folder}/out: expected a place outside the scene" in error


def test_photos_without_common_features(make_scene_folder, tmp_path):
    error = refused("triangulate", make_scene_folder(), tmp_path / "out", "--threads", 1)
    lines = error.splitlines()
    assert "at least 50 points, found 0: " in lines[-1] and "add images that overlap" in lines[-1]
    assert "was kept" in lines[-2]
    assert not (tmp_path / "out").exists()


@pytest.fixture
def registered(make_scene_folder):
    """Three periods, and what a registration writes beside the scene; labels are ids."""
    folder = make_scene_folder({f"{p}/{i}.png": j for j, p in enumerate("abc") for i in range(3)})
    for name in ("georeference.json", "registration.json", "registration.html"):
        (folder / name).write_text(f"{name} of register")
    return folder


@pytest.mark.parametrize(
    ("options", "kept"),
    [
        (("--drop", "a/0.png"), True),
        (("--keep-period", "0", "--keep-period", "1"), True),
        (("--crop=-100,-100,-100,100,100,100",), True),
        (("--rename", "0=before"), False),
        (("--rename", "0=x", "--rename", "1=x"), False),
        (("--rename", "a/0.png=b/9.png"), False),
        (("--drop-period", "0"), False),  # periods 1 and 2 are now labelled 0 and 1
    ],
)
def test_records_of_a_registration_come_along(registered, tmp_path, options, kept):
    result = invoke("edit", registered, tmp_path / "out", *options)
    assert result.exit_code == 0, result.output
    frame, certificate = (
        tmp_path / "out" / f"{name}.json" for name in ("georeference", "registration")
    )
    assert frame.read_text() == "georeference.json of register"
    assert certificate.exists() == kept
    assert ("note: registration.json is not copied: a certificate" in result.stderr) != kept
    assert "and not converted: registration.html\n" in result.stderr


def test_no_certificate_no_note(make_scene_folder, tmp_path):
    result = invoke("edit", make_scene_folder(), tmp_path / "out", "--rename", "0=before")
    assert "registration.json" not in result.stderr


def test_triangulate_takes_the_records_of_a_registration_along(registered, tmp_path, monkeypatch):
    def stand_in(scene, out, **_):
        our_format.write(scene, out)
        return Triangulated(read_scene(out), 1, 1, 1)

    monkeypatch.setattr(triangulate, "triangulate", stand_in)
    result = invoke("triangulate", registered, tmp_path / "out")
    assert result.exit_code == 0, result.output
    for name in ("georeference.json", "registration.json"):
        assert (tmp_path / "out" / name).read_text() == f"{name} of register"
    assert "and not converted: registration.html\n" in result.stderr
