import shutil

import pytest
from PIL import Image

IMAGES, SPLIT = "sparse/0/images.txt", "sparse/split.txt"


def in_folders(scene):
    """Rename all images to ``a/000.png`` and so on, in the model, on disk and in the lists."""
    for letter in "ab":
        scene.path(f"images/{letter}").mkdir()
        for i in range(9):
            old, new = f"{letter}{i:03d}.png", f"{letter}/{i:03d}.png"
            scene.path(f"images/{old}").rename(scene.path(f"images/{new}"))
            for place in (IMAGES, SPLIT, "sparse/0/test.txt"):
                if old in scene.path(place).read_text():
                    scene.replace(place, old, new)


def test_split_absent(scene):
    scene.path(SPLIT).unlink()
    scene.expect("CS301", place=SPLIT, found="no such file")


def test_split_absent_where_a_command_can_write_it(scene):
    scene.path(SPLIT).unlink()
    (finding,) = [f for f in scene.validate().findings if f.code == "CS301"]
    assert "chronoscene convert DIR OUT do it, and name the periods: --period-by" in finding.remedy
    assert "table:FILE (a CSV file with the columns file and period)" in finding.remedy
    shutil.rmtree(scene.path("images"))
    (finding,) = [f for f in scene.validate().findings if f.code == "CS301"]
    assert finding.remedy == 'write one line "<image name> <period id>" for each image'


@pytest.mark.parametrize("file", ["Split.txt", "splits.txt", "split.txt.txt", "0/split.csv"])
def test_split_under_another_name(scene, file):
    scene.path(SPLIT).rename(scene.path(f"sparse/{file}"))
    scene.expect("CS301", place=SPLIT, found=f"no such file; there is 'sparse/{file}'")


def test_split_misplaced(scene):
    scene.path(SPLIT).rename(scene.path("sparse/0/split.txt"))
    report = scene.expect("CS301", place=SPLIT, found="sparse/0/split.txt instead")
    assert next(f for f in report.findings if f.code == "CS301").remedy == "move the file"


@pytest.mark.parametrize("data", [b"\x00\xff\xfe\xe4\xf6", b"a\xe4.png 0\n"])
def test_split_not_text(scene, data):
    scene.write(SPLIT, data)
    scene.expect("CS302", place=SPLIT, found="not UTF-8")


def test_split_that_is_a_folder(scene):
    scene.path(SPLIT).unlink()
    scene.path(SPLIT).mkdir()
    scene.expect("CS302", place=SPLIT, found="no readable file")


def test_split_line(scene):
    scene.replace(SPLIT, "a001.png 0\n", "a001.png\n")
    scene.expect("CS303", place=f"{SPLIT}:2", found="'a001.png'")


@pytest.mark.parametrize("period", ["2016-05", "-1", "1.0", "x"])
def test_split_period(scene, period):
    scene.replace(SPLIT, "a001.png 0", f"a001.png {period}")
    scene.expect("CS304", place=f"{SPLIT}:2", found=period)


def test_image_without_period(scene):
    scene.replace(SPLIT, "a001.png 0\n", "")
    scene.expect("CS305", place=f"{IMAGES} (a001.png)", found="none with this name")


def test_split_ambiguous(scene):
    in_folders(scene)
    scene.replace(SPLIT, "a/001.png 0", "001 0")
    scene.expect(
        "CS306", place=f"{SPLIT}:2", found="'a/001.png', 'b/001.png'", also={"CS702", "CS703"}
    )


def test_full_names_are_not_ambiguous(scene):
    in_folders(scene)
    found = {f.code for f in scene.validate().findings}
    assert found == {"CS507", "CS702", "CS703"}


def test_split_contradiction(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "a001.png 1"])
    scene.expect("CS307", place=f"{SPLIT}:19", found="period 1")


def test_split_duplicate(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "a001 0"])
    scene.expect("CS308", place=f"{SPLIT}:19", found="'a001.png' as in line 2")


def test_split_unknown(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "nobody.png 1"])
    scene.expect("CS309", place=f"{SPLIT}:19", found="'nobody.png'")


def test_split_line_ends(scene):
    scene.write(SPLIT, b"".join(f"{line}\r\n".encode() for line in scene.lines(SPLIT)))
    scene.expect("CS310", place=SPLIT, found="carriage returns in 18 lines")


@pytest.mark.parametrize("name", ["A001.PNG", '"a001.png"', "a001.png,", "images\\a001.png"])
def test_what_a_misspelt_name_means_is_said(scene, name):
    scene.replace(SPLIT, "a001.png 0", f"{name} 0")
    scene.expect("CS305", place=f"{IMAGES} (a001.png)", found=f"; line 2 has {name!r}")


def test_misspelt_name_of_an_image_that_has_a_period(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "A001.PNG 0"])
    scene.expect("CS309", place=f"{SPLIT}:19", found="; there is 'a001.png'")


@pytest.mark.parametrize("separator", [",", ";"])
def test_a_table_with_other_separators_is_one_kind_of_finding(scene, separator):
    scene.write(SPLIT, [line.replace(" ", separator) for line in scene.lines(SPLIT)])
    scene.expect("CS303", times=18)


def test_commas_and_blanks(scene):
    scene.write(SPLIT, [line.replace(" ", ", ") for line in scene.lines(SPLIT)])
    scene.expect("CS305", found="; line 1 has 'a000.png,'", times=18)


@pytest.mark.parametrize("encoding", ["utf-16-le", "utf-32"])
def test_encodings_that_nobody_can_guess(scene, encoding):
    scene.write(SPLIT, scene.path(SPLIT).read_text().encode(encoding))
    scene.expect("CS302", place=SPLIT)


def test_a_period_of_unregistered_images_is_one_finding(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), *(f"c{i:03d}.png 2" for i in range(9))])
    scene.expect("CS402", found="none")


TEST = "sparse/0/test.txt"


def test_absent(scene):
    scene.path(TEST).unlink()
    found = "every 8th image of each period in name order (index 0, 8, ...) gives 4 test views"
    scene.expect("CS321", place=TEST, found=found, also={"CS706"})


def test_misplaced(scene):
    scene.path(TEST).rename(scene.path("sparse/test.txt"))
    scene.expect("CS322", place=TEST, found="sparse/test.txt instead")


def test_not_text(scene):
    scene.write(TEST, b"a\xe4.png\n")
    scene.expect("CS323", place=TEST, found="not UTF-8")


def test_unknown(scene):
    scene.write(TEST, [*scene.lines(TEST), "nobody"])
    scene.expect("CS324", place=f"{TEST}:7", found="'nobody'")


def test_ambiguous(scene):
    # Two images of one stem: jpg beside png.
    Image.open(scene.path("images/a001.png")).save(scene.path("images/a000.jpg"))
    scene.path("images/a001.png").unlink()
    for place in ("sparse/0/images.txt", "sparse/split.txt"):
        scene.replace(place, "a001.png", "a000.jpg")
    scene.write(TEST, ["a000", "b003"])
    found = "'a000', which matches 'a000.jpg', 'a000.png'"
    scene.expect("CS325", place=f"{TEST}:1", found=found, also={"CS404", "CS702"})


@pytest.mark.parametrize("line", ["A001.PNG", "a001.png 0"])
def test_what_a_misspelt_test_name_means_is_said(scene, line):
    scene.write(TEST, [*scene.lines(TEST), line])
    scene.expect("CS324", place=f"{TEST}:7", found="; there is 'a001.png'")
