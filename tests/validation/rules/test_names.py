import os

import pytest

from chronoscene.validation.checks import pixels
from chronoscene.validation.rules.names import is_portable
from chronoscene.validation.scene_folder import RawScene

IMAGES = "sparse/0/images.txt"


def test_duplicate_name(scene):
    scene.edit_fields(IMAGES, 2, {9: "a000.png"})
    also = {"CS202", "CS309"}  # nothing is left of a001.png
    scene.expect("CS107", place="images.txt", found="'a000.png' 2 times", also=also)


@pytest.mark.parametrize("name", ["../a000.png", "/tmp/a000.png", "x/../../a.png", "C:/a.png"])
def test_name_leaves_folder(scene, name):
    scene.edit_fields(IMAGES, 0, {9: name})
    # The file of that name is known to be meant; with another name nothing is.
    also = {"CS309"} if name.endswith("a000.png") else {"CS202", "CS309"}
    scene.expect("CS111", place="images.txt", found=repr(name), also=also)


def test_files_outside_are_not_opened(scene, monkeypatch):
    opened = []
    monkeypatch.setattr(pixels, "read_header", lambda path: opened.append(path))
    scene.write("secret.png", b"x")
    scene.edit_fields(IMAGES, 0, {9: "../secret.png"})
    assert len(RawScene(scene.root).headers) == 13
    assert not [path for path in opened if "secret" in str(path)]


def test_name_not_utf8(scene):
    scene.to_binary()
    path = scene.path("sparse/0/images.bin")
    path.write_bytes(path.read_bytes().replace(b"a000.png", b"a\xe4\xf600.png"[:8], 1))
    report = scene.expect(
        "CS112",
        place="images.bin",
        found="'a\\udce4\\udcf600.pn'",
        also={"CS201", "CS202", "CS305", "CS309"},
    )
    assert all(str(f).isprintable() for f in report.findings)


def test_control_characters_do_not_reach_the_terminal(scene):
    scene.to_binary()
    path = scene.path("sparse/0/images.bin")
    path.write_bytes(path.read_bytes().replace(b"a000.png", b"\x1b[31m.pn", 1))
    report = scene.expect("CS112", also={"CS201", "CS202", "CS305", "CS309"})
    assert "\x1b" not in "".join(map(str, report.findings))


def rename(scene, old, new):
    """An image gets another name, everywhere."""
    for place in (IMAGES, "sparse/split.txt"):
        scene.replace(place, old, new)
    os.rename(scene.path(f"images/{old}"), scene.path(f"images/{new}"))


def test_names_that_differ_by_case(scene):
    rename(scene, "a001.png", "A000.PNG")
    scene.expect("CS113", place=IMAGES, found="'A000.PNG', 'a000.png'")


def test_names_that_differ_by_unicode_form(scene):
    rename(scene, "a000.png", "\u00e9.png")
    rename(scene, "a001.png", "e\u0301.png")
    scene.expect("CS113", place=IMAGES, found="e\u0301.png")


def test_name_not_portable(scene):
    rename(scene, "a000.png", "12:00:00.png")
    scene.expect("CS114", place="images", found="1 name that others cannot: '12:00:00.png'")


@pytest.mark.parametrize(
    "name",
    ["a?.png", "a.png.", "a .jpg/b.png ", "AUX.png", "x/con/a.png", "lpt1", "b\\c.png", "é" * 130],
)
def test_names_that_are_not_portable(name):
    assert not is_portable(name)


@pytest.mark.parametrize(
    "name", ["a b.png", "2016/IMG_0001.JPG", "auxiliary.png", "é.png", "a.b.c"]
)
def test_names_that_are_portable(name):
    assert is_portable(name)
