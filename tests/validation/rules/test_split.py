import pytest

IMAGES, SPLIT = "sparse/0/images.txt", "sparse/split.txt"


def in_folders(scene):
    """Rename all images to ``a/000.png`` and so on, in the model, on disk and in the lists."""
    for letter in "ab":
        scene.path(f"images/{letter}").mkdir()
        for i in range(7):
            old, new = f"{letter}{i:03d}.png", f"{letter}/{i:03d}.png"
            scene.path(f"images/{old}").rename(scene.path(f"images/{new}"))
            for place in (IMAGES, SPLIT, "sparse/0/test.txt"):
                if old in scene.path(place).read_text():
                    scene.replace(place, old, new)


def test_split_absent(scene):
    scene.path(SPLIT).unlink()
    scene.expect("CS301", place=SPLIT, found="no such file")


def test_split_misplaced(scene):
    scene.path(SPLIT).rename(scene.path("sparse/0/split.txt"))
    report = scene.expect("CS301", place=SPLIT, found="sparse/0/split.txt instead")
    assert next(f for f in report.findings if f.code == "CS301").remedy == "move it"


@pytest.mark.parametrize("data", [b"\x00\xff\xfe\xe4\xf6", b"a\xe4.png 0\n"])
def test_split_not_text(scene, data):
    scene.write(SPLIT, data)
    scene.expect("CS302", place=SPLIT, found="not UTF-8")


def test_split_that_is_a_folder(scene):
    scene.path(SPLIT).unlink()
    scene.path(SPLIT).mkdir()
    scene.expect("CS302", place=SPLIT, found="no file to read")


def test_split_line(scene):
    scene.replace(SPLIT, "a001.png 0\n", "a001.png\n")
    scene.expect("CS303", place=f"{SPLIT}:2", found="'a001.png'", also={"CS305"})


@pytest.mark.parametrize("period", ["2016-05", "-1", "1.0", "x"])
def test_split_period(scene, period):
    scene.replace(SPLIT, "a001.png 0", f"a001.png {period}")
    scene.expect("CS304", place=f"{SPLIT}:2", found=period, also={"CS305"})


def test_image_without_period(scene):
    scene.replace(SPLIT, "a001.png 0\n", "")
    scene.expect("CS305", place=f"{IMAGES} (a001.png)", found="none that names it")


def test_split_ambiguous(scene):
    in_folders(scene)
    scene.replace(SPLIT, "a/001.png 0", "001 0")
    scene.expect(
        "CS306",
        place=f"{SPLIT}:2",
        found="'a/001.png', 'b/001.png'",
        also={"CS305", "CS702", "CS703"},
    )


def test_full_names_are_not_ambiguous(scene):
    in_folders(scene)
    found = {f.code for f in scene.validate().findings}
    assert found == {"CS507", "CS702", "CS703"}


def test_split_contradiction(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "a001.png 1"])
    scene.expect("CS307", place=f"{SPLIT}:15", found="period 1")


def test_split_duplicate(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "a001 0"])
    scene.expect("CS308", place=f"{SPLIT}:15", found="'a001.png' as in 2")


def test_split_unknown(scene):
    scene.write(SPLIT, [*scene.lines(SPLIT), "nobody.png 1"])
    scene.expect("CS309", place=f"{SPLIT}:15", found="'nobody.png'")


def test_split_line_ends(scene):
    scene.write(SPLIT, b"".join(f"{line}\r\n".encode() for line in scene.lines(SPLIT)))
    scene.expect("CS310", place=SPLIT, found="carriage returns in 14 lines")
