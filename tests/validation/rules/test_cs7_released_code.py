import pytest
from PIL import Image

from chronoscene.validation.rules.cs7_released_code import official_failure

SPLIT, TEST = "sparse/split.txt", "sparse/0/test.txt"


def official_parser(line):
    """What the released loader does with a line, as the format description says."""
    fields = line.strip().split(" ")
    return fields[0].split(".")[0], int(fields[1])


@pytest.mark.parametrize(
    ("line", "found"),
    [("a001.png  0", "two spaces"), ("a001.png\t0", "a tab"), ("a001.png 0\n", "an empty line")],
)
def test_official_split_line(scene, line, found):
    scene.replace(SPLIT, "a001.png 0", line)
    row = 3 if "\n" in line else 2
    scene.expect("CS701", place=f"{SPLIT}:{row}", found=found)


def test_byte_order_mark(scene):
    scene.write(SPLIT, b"\xef\xbb\xbf" + scene.path(SPLIT).read_bytes())
    scene.expect("CS701", place=f"{SPLIT}:1", found="byte order mark")


def test_utf16(scene):
    scene.write(SPLIT, scene.path(SPLIT).read_text().encode("utf-16"))
    scene.expect("CS701", place=SPLIT, found="UTF-16")


@pytest.mark.parametrize(
    "line", ["a 0", "a.b.png 12", "a  0", "a\t0", "", "   ", "old town.jpg 0", "a", "a x", " a 1 "]
)
def test_failures_are_those_of_the_parser(line):
    try:
        official_parser(line)
        works = True
    except (ValueError, IndexError):
        works = False
    assert (official_failure(line) is None) == works


def test_line_that_it_misreads():
    assert official_parser("old 1 town.jpg 0") == ("old", 1)
    assert (
        official_failure("old 1 town.jpg 0") == "more than two fields; it reads period 1 for 'old'"
    )


def test_official_name_collision(scene):
    scene.path("images/a001.png").rename(scene.path("images/a000.1.png"))
    for place in ("sparse/0/images.txt", SPLIT):
        scene.replace(place, "a001.png", "a000.1.png")
    found = "'a000.1.png', 'a000.png', all known to it as 'a000'"
    scene.expect("CS702", place="sparse/0/images.txt", found=found)


def test_official_folders(scene):
    scene.path("images/x").mkdir()
    scene.path("images/a001.png").rename(scene.path("images/x/a001.png"))
    for place in ("sparse/0/images.txt", SPLIT):
        scene.replace(place, "a001.png", "x/a001.png")
    scene.expect("CS703", place="images", found="1 image in folders: 'x/a001.png'")


def test_official_grey(scene):
    image = Image.open(scene.path("images/a001.png")).convert("L")
    image.save(scene.path("images/a001.png"))
    scene.expect("CS704", place="images/a001.png", found="L")


def test_official_principal_point(scene):
    scene.write("sparse/0/cameras.txt", ["1 PINHOLE 64 48 50 50 31 24.5"])
    scene.expect("CS705", place="(camera 1)", found="(-1, +0.5) px")


def test_half_a_pixel_is_nothing(scene):
    scene.write("sparse/0/cameras.txt", ["1 PINHOLE 64 48 50 50 31.5 23.5"])
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_official_default_split(scene):
    scene.path(TEST).unlink()
    # Ours: a000, a008, b000, b008. Theirs: the images 0, 8 and 16 of all.
    scene.expect("CS706", place=TEST, found="3 other test images", also={"CS321"})
