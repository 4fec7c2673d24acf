"""Each correction alone: the copy has none of the fixed codes, and the scene stays as it was."""

import hashlib
import io
import json
import os
import signal
import unicodedata

import numpy as np
import pytest
from PIL import Image

from chronoscene.colmap.model import read_raw_model, read_reconstruction
from chronoscene.errors import ChronoSceneError, DiskFullError
from chronoscene.formats import read_scene
from chronoscene.io.processes import stoppable
from chronoscene.validation.repair.fix import fix_scene
from chronoscene.validation.run import validate_scene

SPLIT, TEST = "sparse/split.txt", "sparse/0/test.txt"
CAMERAS, IMAGES, POINTS = (f"sparse/0/{stem}.txt" for stem in ("cameras", "images", "points3D"))


def state(root):
    return {p.relative_to(root): p.read_bytes() if p.is_file() else None for p in root.rglob("*")}


def codes(report):
    return {f.code for f in report.findings}


@pytest.fixture
def fix(scene, tmp_path):
    """Correct the scene; check what must hold for every correction; give codes and copy."""

    def run():
        before, spoken = state(scene.root), codes(scene.validate())
        repairs = fix_scene(scene.root, tmp_path / "fixed")
        assert state(scene.root) == before
        after = codes(validate_scene(tmp_path / "fixed"))
        fixed = {repair.code for repair in repairs} - {""}
        assert fixed <= spoken and not fixed & after
        assert after <= spoken | {"CS507"}
        # Once is enough.
        assert not [r for r in fix_scene(tmp_path / "fixed", tmp_path / "again") if r.code]
        return fixed, after, tmp_path / "fixed"

    return run


def test_good_scene_stays_the_same(scene, fix):
    fixed, after, out = fix()
    assert (fixed, after) == (set(), {"CS507"})
    ours, theirs = read_scene(scene.root), read_scene(out)
    assert [f.name for f in ours.frames] == [f.name for f in theirs.frames]
    for name in ("ids", "xyz", "rgb", "error", "track_start", "track_frame", "track_xy"):
        np.testing.assert_array_equal(getattr(ours.points, name), getattr(theirs.points, name))
    assert (out / "sparse/0/points3D.bin").is_file() and not (out / POINTS).exists()
    assert os.stat(out / "images/a000.png").st_nlink == 3  # hard links: no space is taken


def test_binary_model_without_faults_is_not_written_again(scene, fix):
    scene.to_binary(classic=False)
    _, _, out = fix()
    for stem in ("cameras", "images", "points3D", "rigs", "frames"):
        file = f"sparse/0/{stem}.bin"
        assert os.path.samefile(out / file, scene.path(file))


def write_split(scene, change, encode="utf-8"):
    scene.write(SPLIT, "".join(change(line) for line in scene.lines(SPLIT)).encode(encode))


SPLITS = {
    "tabs": (lambda s: write_split(s, lambda t: t.replace(" ", "\t") + "\n"), {"CS701"}),
    "blanks": (lambda s: write_split(s, lambda t: f" {t.replace(' ', '   ')} \n\n"), {"CS701"}),
    "windows": (lambda s: write_split(s, lambda t: t + "\r\n"), {"CS310"}),
    "mark": (lambda s: write_split(s, lambda t: t + "\n", "utf-8-sig"), {"CS701"}),
    "utf-16": (lambda s: write_split(s, lambda t: t + "\n", "utf-16"), {"CS701"}),
    "unknown": (lambda s: s.write(SPLIT, [*s.lines(SPLIT), "nobody 1"]), {"CS309"}),
    "twice": (lambda s: s.write(SPLIT, [*s.lines(SPLIT), "a000 0"]), {"CS308"}),
    "gaps": (
        lambda s: write_split(s, lambda t: t[:-1] + str(3 + 4 * int(t[-1])) + "\n"),
        {"CS401"},
    ),
    "elsewhere": (lambda s: s.path(SPLIT).rename(s.path("split.txt")), {"CS301"}),
}


@pytest.mark.parametrize("case", SPLITS)
def test_split(scene, fix, case):
    good = scene.path(SPLIT).read_text()
    change, expected = SPLITS[case]
    change(scene)
    fixed, after, out = fix()
    assert (fixed, after) == (expected, {"CS507"})
    assert (out / SPLIT).read_text() == good
    assert not (out / "split.txt").exists()


def test_short_names_become_full_names(scene, fix):
    good = scene.path(SPLIT).read_text()
    scene.write(SPLIT, [line.replace(".png", "") for line in scene.lines(SPLIT)])
    _, after, out = fix()
    assert (out / SPLIT).read_text() == good and after == {"CS507"}


@pytest.mark.parametrize(
    ("lines", "remains"),
    [
        (["a000.png 1"], "CS307"),
        (["nonsense"], "CS303"),
        (["a000.png 2016-05"], "CS304"),
        (["nobody.png 2"], "CS402"),
    ],
)
def test_what_only_people_can_decide_stays(scene, fix, lines, remains):
    scene.write(SPLIT, [*scene.lines(SPLIT), *lines])
    fixed, after, out = fix()
    assert fixed == set() and remains in after
    assert (out / SPLIT).read_text().splitlines()[-len(lines) :] == lines


TYPING_ERRORS = {
    "a digit too many": (lambda t: t.replace("a001.png 0", "a001.png 12"), "CS401"),
    "a letter": (lambda t: t.replace("a001.png 0", "a001.png O"), "CS304"),
    "a letter in all lines of a period": (lambda t: t.replace(".png 0", ".png O"), "CS304"),
    "a number after the id": (lambda t: t.replace("a001.png 0", "a001.png 0 1"), "CS305"),
}


@pytest.mark.parametrize("case", TYPING_ERRORS)
def test_a_typing_error_does_not_become_a_period(scene, fix, case):
    change, code = TYPING_ERRORS[case]
    scene.write(SPLIT, change(scene.path(SPLIT).read_text()))
    wrong = scene.path(SPLIT).read_text()
    fixed, after, out = fix()
    assert fixed == set() and code in after
    assert (out / SPLIT).read_text() == wrong


def test_ids_that_contradict_the_labels_stay(scene, fix):
    scene.write(SPLIT, scene.path(SPLIT).read_text().replace(".png 0", ".png 2"))
    labels = [{"id": 0, "label": "before"}, {"id": 1, "label": "after"}]
    scene.write("sparse/periods.json", json.dumps(labels))
    _, after, out = fix()
    assert "CS401" in after and {line[-1] for line in scene.lines(SPLIT)} == {"1", "2"}
    assert (out / SPLIT).read_text() == scene.path(SPLIT).read_text()


def test_labels_follow_their_periods(scene, fix):
    SPLITS["gaps"][0](scene)
    labels = [{"id": 3, "label": "before"}, {"id": 7, "label": "after"}]
    scene.write("sparse/periods.json", json.dumps(labels))
    _, _, out = fix()
    assert [p.label for p in read_scene(out).periods] == ["before", "after"]


TESTS = {
    "unknown": (["a003.png", "b003.png", "nobody"], {"CS324"}),
    "twice": (["a003.png", "b003.png", "a003.png"], set()),
    "short": (["a003", "b003.jpg"], set()),
}


@pytest.mark.parametrize("case", TESTS)
def test_test_list(scene, fix, case):
    lines, expected = TESTS[case]
    scene.write(TEST, lines)
    fixed, after, out = fix()
    assert (fixed, after) == (expected, {"CS507"})
    assert (out / TEST).read_text() == "a003.png\nb003.png\n"


@pytest.mark.parametrize(
    ("text", "repair"),
    [
        ("a003\nb003.png\n", "1 name in test.txt written in full"),
        (
            "\ufeffa003.png\r\n\r\nb003.png",
            "test.txt saved as UTF-8 with Unix line endings, without needless blanks",
        ),
    ],
)
def test_changes_of_the_test_list_are_listed(scene, tmp_path, text, repair):
    scene.to_binary()
    scene.write(TEST, text.encode())
    assert fix_scene(scene.root, tmp_path / "fixed") == [("", repair)]
    assert (tmp_path / "fixed" / TEST).read_bytes() == b"a003.png\nb003.png\n"
    assert fix_scene(tmp_path / "fixed", tmp_path / "again") == []


def test_misplaced_test_list(scene, fix):
    scene.path(TEST).rename(scene.path("test.txt"))
    fixed, after, out = fix()
    assert (fixed, after) == ({"CS322"}, {"CS507"})
    assert not (out / "test.txt").exists()


def test_test_list_of_unknown_names_only_stays(scene, fix):
    scene.write(TEST, "x\ny\n")
    fixed, after, out = fix()
    assert fixed == set() and {"CS324", "CS407"} <= after
    assert (out / TEST).read_text() == "x\ny\n"


MODELS = {
    "quaternion": (lambda s: s.edit_fields(IMAGES, 0, {1: "2", 2: "0", 3: "0", 4: "0"}), "CS122"),
    "not finite": (lambda s: s.edit_fields(POINTS, 0, {1: "nan"}), "CS502"),
    "broken track": (lambda s: s.edit_fields(POINTS, 0, {9: "999"}), "CS504"),
}


@pytest.mark.parametrize("case", MODELS)
def test_model(scene, fix, case):
    change, code = MODELS[case]
    change(scene)
    before = scene.validate()
    fixed, after, out = fix()
    assert code in fixed
    assert len(read_raw_model(out / "sparse/0").points) == (39 if case == "not finite" else 40)
    if case == "broken track":
        assert "CS505" in codes(before) and "CS505" in after  # which of both is right?


def test_short_tracks_are_removed_with_their_points(scene, fix):
    for row, kept in ((0, 1), (1, 0)):
        words = scene.lines(POINTS)[row].split()
        lines = scene.lines(POINTS)
        lines[row] = " ".join(words[: 8 + 2 * kept])
        scene.write(POINTS, lines)
    lines = scene.lines(IMAGES)
    for image in range(18):
        words = lines[2 * image + 1].split()
        words[2] = "1" if image == 0 else "-1"
        words[5] = "-1"
        lines[2 * image + 1] = " ".join(words)
    scene.write(IMAGES, lines)
    fixed, after, out = fix()
    assert fixed == {"CS503"} and after == {"CS507"}
    assert read_raw_model(out / "sparse/0").points.ids.tolist() == list(range(3, 41))


def test_points_of_a_laser_scan_stay(scene, fix):
    scene.write(POINTS, [" ".join(line.split()[:8]) for line in scene.lines(POINTS)])
    fixed, after, out = fix()
    assert "CS503" in after and fixed == set()
    assert len(read_raw_model(out / "sparse/0").points) == 40


def test_observation_that_is_not_finite(scene, fix):
    scene.to_binary()
    path = scene.path("sparse/0/images.bin")
    data = bytearray(path.read_bytes())
    at = data.index(b"a000.png\0") + 9 + 8
    data[at : at + 8] = np.float64("nan").tobytes()
    path.write_bytes(data)
    fixed, after, _ = fix()
    assert fixed == {"CS510"} and after == {"CS507"}


def test_misplaced_model(scene, fix):
    for stem in ("cameras", "images", "points3D"):
        scene.path(f"sparse/0/{stem}.txt").rename(scene.path(f"sparse/{stem}.txt"))
    fixed, after, out = fix()
    assert (fixed, after) == ({"CS002"}, {"CS507"})
    assert not (out / "sparse/cameras.txt").exists()


def test_text_beside_binary(scene, fix):
    text = scene.path(CAMERAS).read_text()
    scene.to_binary()
    scene.write(CAMERAS, text)
    fixed, after, out = fix()
    assert (fixed, after) == ({"CS104"}, {"CS507"})
    assert not (out / CAMERAS).exists()


def test_misspelt_image(scene, fix, tmp_path):
    """Its mask follows, and so do the masks that need not be renamed, and those that are links."""
    scene.path("masks").mkdir()
    for name in ("A000.PNG", *(f"a{i:03d}.png" for i in range(1, 9))):
        Image.new("L", (64, 48), 255).save(scene.path(f"masks/{name}.png"))
    scene.path("masks/a006.png.png").rename(tmp_path / "mask.png")
    scene.path("masks/a006.png.png").symlink_to(tmp_path / "mask.png")
    scene.path("images/a000.png").rename(scene.path("images/A000.PNG"))
    fixed, after, out = fix()
    assert fixed == {"CS201"} and after == {"CS507"}
    assert not (out / "images/A000.PNG").exists()
    assert sorted(p.name for p in (out / "masks").iterdir()) == [
        f"a{i:03d}.png.png" for i in range(9)
    ]


def test_masks_of_another_spelling(scene, fix):
    """Accents are characters of their own in names of macOS, for example."""
    name = unicodedata.normalize("NFC", "pläne.png")
    scene.path("images/a000.png").rename(scene.path(f"images/{name}"))
    for place in ("sparse/0/images.txt", "sparse/split.txt"):
        scene.replace(place, "a000.png", name)
    scene.path("masks").mkdir()
    names = (unicodedata.normalize("NFD", name), "A001.PNG", *(f"a00{i}.png" for i in range(2, 9)))
    for i, mask in enumerate(names):
        Image.new("L", (64, 48), 255 - i).save(scene.path(f"masks/{mask}.png"))
    fixed, after, out = fix()
    assert fixed == {"CS243"} and after == {"CS507"}
    assert {p.name for p in (out / "masks").iterdir()} == {
        f"{name}.png", *(f"a00{i}.png.png" for i in range(1, 9)),
    }  # fmt: skip


def tagged(image, orientation, *, order="<"):
    exif = Image.Exif()
    exif.endian = order
    exif[0x010F], exif[0x0112] = "Maker", orientation
    image.save(file := io.BytesIO(), "JPEG", exif=exif)
    return file.getvalue()


@pytest.mark.parametrize("order", ["<", ">"])
def test_orientation_tag(scene, fix, order):
    scene.save("a000.png", Image.new("RGB", (64, 48)), as_name="a000.jpg")
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8))
    scene.write("images/a000.jpg", tagged(noise, 6, order=order))
    fixed, after, out = fix()
    assert fixed == {"CS207"} and after == {"CS507"}
    with (
        Image.open(out / "images/a000.jpg") as new,
        Image.open(scene.path("images/a000.jpg")) as old,
    ):
        np.testing.assert_array_equal(np.asarray(new), np.asarray(old))
        assert new.getexif()[0x010F] == "Maker"


def test_orientation_tag_of_a_misspelt_image(scene, fix):
    """One pass is enough for both, and the original keeps its bytes."""
    scene.save("a000.png", Image.new("RGB", (64, 48)), as_name="a000.jpg")
    scene.save("a001.png", Image.new("RGB", (64, 48)), as_name="a001.jpg")
    scene.save("a002.png", Image.new("RGB", (48, 64)))  # has the error that a001.jpg will have
    for name, size in (("a000.jpg", (64, 48)), ("a001.jpg", (48, 64))):
        scene.path(f"images/{name}").unlink()
        scene.write(f"images/{name.upper()}", tagged(Image.new("RGB", size), 6))
    before = scene.path("images/A000.JPG").read_bytes()
    fixed, after, out = fix()
    assert fixed == {"CS201"} and after == {"CS204", "CS507"}
    assert not (out / "images/A000.JPG").exists()
    for name, tag in (("a000.jpg", 1), ("a001.jpg", 6)):
        with Image.open(out / "images" / name) as image:
            assert image.getexif().get(0x0112, 1) == tag
    assert scene.path("images/A000.JPG").read_bytes() == before


def test_orientation_tag_that_the_camera_agrees_with_stays(scene, fix):
    scene.save("a000.png", Image.new("RGB", (64, 48)), as_name="a000.jpg")
    scene.write("images/a000.jpg", tagged(Image.new("RGB", (48, 64)), 6))
    fixed, after, _ = fix()
    assert fixed == set() and "CS204" in after


def test_model_that_cannot_be_read_is_copied(scene, fix):
    scene.write(CAMERAS, "nonsense\n")
    fixed, after, out = fix()
    assert fixed == set() and "CS103" in after
    assert (out / CAMERAS).read_text() == "nonsense\n"


def test_other_files_come_along_but_no_links_out_of_the_scene(scene, tmp_path):
    (tmp_path / "secret").write_text("secret")
    scene.path("images/link.png").symlink_to(tmp_path / "secret")
    scene.path("images/up").symlink_to(tmp_path)
    scene.write("notes/read me.txt", "notes")
    repairs = fix_scene(scene.root, tmp_path / "fixed")
    assert (tmp_path / "fixed/notes/read me.txt").read_text() == "notes"
    assert not (tmp_path / "fixed/images/link.png").exists()
    assert not (tmp_path / "fixed/images/up").exists()
    assert any("2 links leading out of the scene left out" in repair.text for repair in repairs)


@pytest.mark.parametrize("place", ["scene/inside", "used", "file"])
def test_where_it_may_not_go(scene, tmp_path, place):
    (tmp_path / "used").mkdir()
    (tmp_path / "used/file").write_text("x")
    (tmp_path / "file").write_text("x")
    digest = hashlib.sha256(repr(state(scene.root)).encode()).digest()
    with pytest.raises(ChronoSceneError, match="choose another"):
        fix_scene(scene.root, tmp_path / place)
    assert hashlib.sha256(repr(state(scene.root)).encode()).digest() == digest


def test_nothing_is_left_behind_by_a_failure(scene, tmp_path, monkeypatch):
    def full(source, target):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("chronoscene.validation.repair.fix._link", full)
    with pytest.raises(DiskFullError, match="No space left"):
        fix_scene(scene.root, tmp_path / "fixed")
    assert [p.name for p in tmp_path.iterdir()] == ["scene"]


@pytest.mark.parametrize("name", ["A001.PNG", '"a001.png"', "images\\a001.png", "C:\\x\\a001.png"])
def test_misspelt_names_are_corrected_not_removed(scene, fix, name):
    scene.replace(SPLIT, "a001.png 0", f"{name} 0")
    fixed, after, out = fix()
    assert (fixed, after) == ({"CS305"}, {"CS507"})
    assert "a001.png 0" in (out / SPLIT).read_text().splitlines()


@pytest.mark.parametrize(("separator", "code"), [(",", "CS303"), (", ", "CS305"), (";", "CS303")])
def test_tables_with_commas(scene, fix, separator, code):
    scene.write(SPLIT, [line.replace(" ", separator) for line in scene.lines(SPLIT)])
    fixed, after, _ = fix()
    assert (fixed, after) == ({code}, {"CS507"})


def test_test_image_with_its_period_stays_a_test_image(scene, fix):
    scene.write(TEST, ["a003.png 0", "B003.PNG"])
    fixed, after, out = fix()
    assert (fixed, after) == ({"CS324"}, {"CS507"})
    assert (out / TEST).read_text() == "a003.png\nb003.png\n"


def test_lines_on_images_with_impossible_names_stay(scene, fix):
    scene.edit_fields(IMAGES, 0, {9: "/home/me/a000.png"})
    _, after, out = fix()
    assert "a000.png 0" in (out / SPLIT).read_text().splitlines()
    assert {"CS111", "CS309"} <= after


def test_an_image_of_that_name_in_another_folder_is_another_one(scene, fix):
    """Its line must not give the period of the one to the other."""
    for place in (IMAGES, SPLIT):
        scene.replace(place, "b001.png", "2023/a001.png")
    scene.path("images/2023").mkdir()
    scene.path("images/b001.png").rename(scene.path("images/2023/a001.png"))
    scene.replace(SPLIT, "2023/a001.png 1", "2019/a001.png 1")
    _, after, out = fix()
    assert "2023/a001.png 1" not in (out / SPLIT).read_text()
    assert "CS305" in after


def test_images_that_are_links_are_linked_again(scene, fix, tmp_path):
    """A scene that was made with links is good, and so must its copy be."""
    scene.path("images").rename(tmp_path / "photos")
    scene.path("images").mkdir()
    for path in (tmp_path / "photos").iterdir():
        scene.path(f"images/{path.name}").symlink_to(path)
    fixed, after, out = fix()
    assert (fixed, after) == (set(), {"CS507"})
    assert (out / "images/a000.png").resolve() == tmp_path / "photos/a000.png"


@pytest.mark.parametrize("folder", ["images", "sparse", "sparse/0"])
def test_folders_that_are_links(scene, fix, tmp_path, folder):
    scene.path(folder).rename(tmp_path / "elsewhere")
    scene.path(folder).symlink_to(tmp_path / "elsewhere")
    assert fix()[:2] == (set(), {"CS507"})


def test_a_model_that_is_a_link_inside_of_the_scene(scene, fix):
    scene.path("sparse/0").rename(scene.path("model"))
    scene.path("sparse/0").symlink_to("../model")
    assert fix()[:2] == (set(), {"CS507"})


@pytest.mark.parametrize(
    ("number", "error"), [(signal.SIGTERM, SystemExit), (signal.SIGINT, KeyboardInterrupt)]
)
def test_interrupted(scene, tmp_path, monkeypatch, number, error):
    def interrupt(*_):
        signal.raise_signal(number)

    monkeypatch.setattr("chronoscene.validation.repair.fix._link", interrupt)
    before = state(tmp_path)
    # What a shell starts in the background ignores interruptions.
    usual = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(error), stoppable():
            fix_scene(scene.root, tmp_path / "fixed")
    finally:
        signal.signal(signal.SIGINT, usual)
    assert state(tmp_path) == before


def test_observations_of_two_images_with_one_id_stay(scene, fix):
    """They are not broken: whose they are is known once an image has got its own id."""
    scene.edit_fields(IMAGES, 2, {0: "1"})
    fixed, after, _ = fix()
    assert fixed == set() and {"CS106", "CS504"} <= after


def test_text_whose_rigs_say_other_poses_stays(scene, tmp_path):
    scene.to_binary(classic=False)
    folder = scene.path("sparse/0")
    read_reconstruction(folder).write_text(str(folder))
    for file in folder.glob("*.bin"):
        file.unlink()
    row = next(i for i, line in enumerate(scene.lines(IMAGES)) if line.endswith("a003.png"))
    scene.edit_fields(IMAGES, row, {5: "40.0"})
    assert "CS143" in codes(scene.validate())
    fix_scene(scene.root, tmp_path / "fixed")
    assert "CS143" in codes(validate_scene(tmp_path / "fixed"))
    old, new = (read_scene(root).frame_poses for root in (scene.root, tmp_path / "fixed"))
    np.testing.assert_array_equal(old, new)


def test_links_in_a_circle_are_left_out(scene, tmp_path):
    scene.path("sparse/periods.json").symlink_to("periods.json")
    fix_scene(scene.root, tmp_path / "fixed")
    assert not os.path.lexists(tmp_path / "fixed/sparse/periods.json")
