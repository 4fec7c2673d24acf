import os
import struct

import pytest

from chronoscene.validation.folder import pixels
from chronoscene.validation.folder.scene_folder import RawScene

CAMERAS, IMAGES, POINTS = (f"sparse/0/{stem}.txt" for stem in ("cameras", "images", "points3D"))


def test_model_absent(scene):
    for stem in (CAMERAS, IMAGES, POINTS):
        scene.path(stem).unlink()
    scene.expect("CS101", place="sparse/0", found="none")


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_model_partial(scene, stem):
    scene.path(f"sparse/0/{stem}.txt").unlink()
    scene.expect("CS102", place=f"sparse/0/{stem}", found="neither")


def test_mixed_forms(scene):
    text = {place: scene.path(place).read_bytes() for place in (CAMERAS, IMAGES, POINTS)}
    scene.to_binary()
    scene.path("sparse/0/cameras.bin").unlink()
    scene.write(CAMERAS, text[CAMERAS])
    scene.expect("CS102", place="sparse/0", found="cameras.txt, images.bin, points3D.bin")


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("classic", [True, False])
def test_binary_model_is_good(scene, stem, classic):
    scene.to_binary(classic=classic)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_truncated_binary(scene, stem):
    scene.to_binary()
    path = scene.path(f"sparse/0/{stem}.bin")
    path.write_bytes(path.read_bytes()[:-5])
    scene.expect("CS103", place=f"sparse/0/{stem}.bin", found="ends inside")


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_trailing_bytes(scene, stem):
    scene.to_binary()
    path = scene.path(f"sparse/0/{stem}.bin")
    path.write_bytes(path.read_bytes() + b"123")
    scene.expect("CS103", place=f"sparse/0/{stem}.bin", found="3 bytes after the last record")


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
@pytest.mark.parametrize("count", [10**12, 2**64 - 1])
def test_absurd_count_is_refused_before_anything_is_allocated(scene, stem, count):
    scene.to_binary()
    path = scene.path(f"sparse/0/{stem}.bin")
    path.write_bytes(struct.pack("<Q", count) + path.read_bytes()[8:])
    scene.expect("CS103", place=f"sparse/0/{stem}.bin", found=f"{count} records announced")


def test_absurd_number_of_keypoints(scene):
    scene.to_binary()
    path = scene.path("sparse/0/images.bin")
    data = bytearray(path.read_bytes())
    at = data.index(b"\0", 8 + 64) + 1
    data[at : at + 8] = struct.pack("<Q", 10**15)
    path.write_bytes(data)
    scene.expect("CS103", place="images.bin", found=f"announces {10**15} keypoints")


def test_unknown_camera_model_id(scene):
    scene.to_binary()
    path = scene.path("sparse/0/cameras.bin")
    data = bytearray(path.read_bytes())
    data[12:16] = struct.pack("<i", 99)
    path.write_bytes(data)
    scene.expect("CS103", place="cameras.bin", found="model id 99 for camera 1")


def test_damaged_frames(scene):
    scene.to_binary(classic=False)
    path = scene.path("sparse/0/frames.bin")
    path.write_bytes(path.read_bytes()[:-9])
    scene.expect("CS103", place="sparse/0/frames.bin", found="frame")


@pytest.mark.parametrize("stem", ["cameras", "images", "points3D"])
def test_empty_binary_file(scene, stem):
    scene.to_binary()
    scene.write(f"sparse/0/{stem}.bin", b"")
    scene.expect("CS103", place=f"{stem}.bin")


def test_every_damaged_text_line_is_named(scene):
    scene.edit_fields(IMAGES, 0, {3: "zero"})
    scene.edit_fields(IMAGES, 4, {1: "one"})
    scene.expect("CS103", place="images.txt:1", found="zero", times=2)
    scene.expect("CS103", place="images.txt:5", found="one", times=2)


def test_damaged_keypoint_and_point_lines(scene):
    scene.write(IMAGES, [*scene.lines(IMAGES)[:1], "1 2", *scene.lines(IMAGES)[2:]])
    scene.expect("CS103", place="images.txt:2", found="'1 2'")
    scene.write(POINTS, [*scene.lines(POINTS)[:-1], "7 0 0 0 1 2 3 x"])
    scene.expect("CS103", place="points3D.txt:40", found="'7 0 0 0 1 2 3 x'", times=2)


@pytest.mark.parametrize("colour", ["nan", "256", "-1", "1.5"])
def test_colour_that_is_none(scene, colour):
    scene.edit_fields(POINTS, 2, {5: colour})
    scene.expect("CS103", place="points3D.txt:3", found=colour)


def test_many_damaged_lines_are_counted(scene):
    scene.write(POINTS, ["broken"] * 500)
    scene.expect("CS103", place="points3D.txt", found="400 more damaged lines", times=101)


@pytest.mark.parametrize(
    "line", ["1 PINHOLE 64 48 50 50 32", "1 PINEHOLE 64 48 50", "1", "a b c d"]
)
def test_damaged_camera_line(scene, line):
    scene.write(CAMERAS, [line])
    scene.expect("CS103", place="cameras.txt:1", found=line)


def test_point_id_twice_in_text(scene):
    scene.write(POINTS, [*scene.lines(POINTS), scene.lines(POINTS)[6]])
    scene.expect("CS103", place="points3D.txt", found="point id 7 twice")


def test_two_forms(scene):
    images = scene.path(IMAGES).read_bytes()
    scene.to_binary()
    scene.write(IMAGES, images)
    scene.expect("CS104", place="sparse/0/images.bin", found="also images.txt")


def test_no_images(scene):
    scene.write(IMAGES, "# none\n")
    scene.write(POINTS, "")
    scene.expect("CS105", place="images.txt", found="none", also={"CS501"})


def test_duplicate_image_id(scene):
    scene.edit_fields(IMAGES, 2, {0: "1"})
    report = scene.validate()
    found = [f.found for f in report.findings if f.code == "CS106"]
    assert found == ["id 1 2 times"]


def test_duplicate_camera_id(scene):
    scene.write(CAMERAS, scene.lines(CAMERAS) * 2)
    scene.expect("CS106", place="cameras.txt", found="id 1 2 times")


def test_unknown_camera(scene):
    scene.edit_fields(IMAGES, 2, {8: "3"})
    scene.expect("CS108", place="images.txt (a001.png)", found="camera 3")


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
    assert len(RawScene(scene.root).headers) == 17
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
