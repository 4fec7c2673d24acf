import json

import pytest
from PIL import Image

IMAGES, SPLIT, TEST = "sparse/0/images.txt", "sparse/split.txt", "sparse/0/test.txt"


def tag(scene, name, taken):
    """Write the date of capture into an image, whose pixels stay."""
    path = scene.path(f"images/{name}")
    with Image.open(path) as image:
        image.load()
        exif = image.getexif()
        exif[0x010F] = "Maker"  # Pillow writes nothing without a tag of the first directory
    exif.get_ifd(0x8769)[0x9003] = taken
    image.save(path, exif=exif)


def tag_all(scene, a, b):
    """Dates with ``{}`` for the minute."""
    for i in range(7):
        tag(scene, f"a{i:03d}.png", a.format(f"{i:02d}"))
        tag(scene, f"b{i:03d}.png", b.format(f"{i + 20:02d}"))


def rename(scene, a, b):
    """Give the images of the periods names like ``2016/x{}.png``."""
    for letter, form in (("a", a), ("b", b)):
        for i in range(7):
            old, new = f"{letter}{i:03d}.png", form.format(f"{i:03d}")
            scene.path(f"images/{new}").parent.mkdir(exist_ok=True)
            scene.path(f"images/{old}").rename(scene.path(f"images/{new}"))
            for place in (IMAGES, SPLIT, TEST):
                if old in scene.path(place).read_text():
                    scene.replace(place, old, new)


def test_a_date_of_no_period(scene):
    tag_all(scene, "2016:05:01 10:{}:00", "2023:05:01 10:{}:00")
    tag(scene, "a002.png", "2020:01:01 10:00:00")
    scene.expect("CS225", place="images/a002.png", found="2020-01-01")


def test_a_date_of_another_period_is_one_finding(scene):
    tag_all(scene, "2016:05:01 10:{}:00", "2023:05:01 10:{}:00")
    tag(scene, "a002.png", "2023:05:01 10:22:30")
    scene.expect("CS222", place="images/a002.png")


def test_visits_of_one_year_are_one_period(scene):
    tag_all(scene, "2016:03:01 10:{}:00", "2023:05:01 10:{}:00")
    tag(scene, "a002.png", "2016:08:01 10:00:00")
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_one_flight_in_two_periods(scene):
    for i in range(7):
        tag(scene, f"a{i:03d}.png", f"2016:05:01 10:{2 * i:02d}:00")
        tag(scene, f"b{i:03d}.png", f"2016:05:01 10:{2 * i + 1:02d}:00")
    scene.expect("CS226", place=SPLIT, found="13 times within five minutes: 'a000.png', 'b000.png'")


def test_days_without_a_time_are_not_one_flight(scene):
    tag_all(scene, "2016:05:01", "2016:05:01")
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_stated_dates_in_reverse(scene):
    periods = [{"id": 0, "date": "2023-05"}, {"id": 1, "date": "2016"}]
    scene.write("sparse/periods.json", json.dumps(periods))
    scene.expect("CS227", place="sparse/periods.json (period 1)", found="2016")


def test_stated_dates_of_different_precision(scene):
    periods = [{"id": 0, "date": "2023-05"}, {"id": 1, "date": "2023"}]
    scene.write("sparse/periods.json", json.dumps(periods))
    assert {f.code for f in scene.validate().findings} == {"CS507"}


@pytest.mark.parametrize(
    ("a", "b", "also"),
    [
        ("2023/x{}.png", "2016/y{}.png", {"CS703"}),
        ("20230501_{}.png", "20160501_{}.png", set()),
        ("site-2023-05-01-{}.png", "site-2016-05-01-{}.png", set()),
    ],
)
def test_years_in_names_in_reverse(scene, a, b, also):
    rename(scene, a, b)
    scene.expect("CS227", place="period 1", found="2016", also=also)


@pytest.mark.parametrize(
    ("a", "b"),
    [
        ("x{}_2023.png", "x{}_2024.png"),
        ("IMG_2050{}.png", "IMG_1980{}.png"),
        ("DJI_2{}.png", "z{}.png"),
    ],
)
def test_numbers_that_are_no_years(scene, a, b):
    rename(scene, a, b)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


@pytest.mark.parametrize(
    ("a", "b", "key"),
    [
        ("2016/x{}.png", "2023/y{}.png", "2016/"),
        ("p0_{}.png", "p1_{}.png", "p0"),
        ("2016-05-01_{}.png", "2023-05-01_{}.png", "2016-05-01"),
    ],
)
def test_an_image_that_its_name_puts_elsewhere(scene, a, b, key):
    rename(scene, a, b)
    name = a.format("001")
    scene.replace(SPLIT, f"{name} 0", f"{name} 1")
    report = scene.validate()
    found = [f for f in report.findings if f.code == "CS228"]
    assert [(f.place, f.found) for f in found] == [(f"{SPLIT} ({name})", "period 1")]
    assert key in found[0].expected
    assert {f.code for f in report.findings} <= {"CS228", "CS507", "CS703"}


def test_folders_of_cameras_say_nothing(scene):
    rename(scene, "left/x{}.png", "right/y{}.png")
    lines = [f"{line.split()[0]} {i % 2}" for i, line in enumerate(scene.lines(SPLIT))]
    scene.write(SPLIT, lines)
    assert "CS228" not in {f.code for f in scene.validate().findings}
