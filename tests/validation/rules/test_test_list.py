import pytest
from PIL import Image

TEST = "sparse/0/test.txt"


def test_absent(scene):
    scene.path(TEST).unlink()
    found = "every 8th image of each period in name order (index 0, 8, ...) gives 2 test views"
    scene.expect("CS321", place=TEST, found=found, also={"CS706"})


def test_misplaced(scene):
    scene.path(TEST).rename(scene.path("sparse/test.txt"))
    scene.expect("CS322", place=TEST, found="sparse/test.txt instead")


def test_not_text(scene):
    scene.write(TEST, b"a\xe4.png\n")
    scene.expect("CS323", place=TEST, found="not UTF-8")


def test_unknown(scene):
    scene.write(TEST, [*scene.lines(TEST), "nobody"])
    scene.expect("CS324", place=f"{TEST}:3", found="'nobody'")


def test_ambiguous(scene):
    # Two images of one stem: jpg beside png.
    Image.open(scene.path("images/a001.png")).save(scene.path("images/a000.jpg"))
    scene.path("images/a001.png").unlink()
    for place in ("sparse/0/images.txt", "sparse/split.txt"):
        scene.replace(place, "a001.png", "a000.jpg")
    scene.write(TEST, ["a000", "b003"])
    found = "'a000', which fits 'a000.jpg', 'a000.png'"
    scene.expect("CS325", place=f"{TEST}:1", found=found, also={"CS404", "CS702"})


def test_duplicate(scene):
    scene.write(TEST, [*scene.lines(TEST), "a003.png"])
    scene.expect("CS326", place=TEST, found="'a003.png' 2 times")


def test_duplicate_in_another_form(scene):
    scene.write(TEST, [*scene.lines(TEST), "a003"])
    scene.expect("CS326", place=TEST, found="'a003.png' 2 times, as 'a003', 'a003.png'")


@pytest.mark.parametrize("line", ["A001.PNG", "a001.png 0"])
def test_what_a_misspelt_name_means_is_said(scene, line):
    scene.write(TEST, [*scene.lines(TEST), line])
    scene.expect("CS324", place=f"{TEST}:3", found="; there is 'a001.png'")
