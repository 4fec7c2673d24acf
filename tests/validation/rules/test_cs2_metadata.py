import json

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.checks.photo_metadata import fit_gps
from chronoscene.validation.folder.scene_folder import RawScene

IMAGES, WORLD = "sparse/0/images.txt", "sparse/world.json"
NAMES = [f"{p}{i:03d}.png" for p in "ab" for i in range(9)]
METRES = 25.0
"""Metres for one world unit in these tests."""

LATITUDE, LONGITUDE = 48.0, 11.0
DEGREE = 111_195.0
"""Metres in a degree of latitude, nearly."""


def tag(scene, name, *, date=None, place=None, focal=None):
    """Write tags into an image, whose pixels stay."""
    path = scene.path(f"images/{name}")
    with Image.open(path) as image:
        image.load()
        exif = image.getexif()
        exif[0x010F] = "Maker"  # Pillow writes nothing without a tag of the first directory
    if date is not None:
        exif.get_ifd(0x8769)[0x9003] = date.replace("-", ":") + " 12:00:00"
    if focal is not None:
        exif.get_ifd(0x8769)[0xA405] = focal
    if place is not None:
        gps = exif.get_ifd(0x8825)
        gps.update({1: "N", 2: degrees(place[0]), 3: "E", 4: degrees(place[1])})
        gps.update({5: b"\0", 6: place[2]})
    image.save(path, exif=exif)


def degrees(value):
    """Whole degrees, whole minutes and seconds."""
    minutes, seconds = divmod(value * 3600, 60)
    return (*divmod(int(minutes), 60), seconds)


def tag_dates(scene, a, b):
    for name in NAMES:
        tag(scene, name, date=a if name[0] == "a" else b)


def tag_places(scene, metres=METRES, moved=(), by=(0.0, 0.0)):
    """Positions of the cameras on the globe, some of them moved by metres east and north."""
    raw = RawScene(scene.root)
    for name, (x, y, z) in zip(raw.images.names, raw.centres * metres, strict=True):
        # The cameras stand on a circle in x and z; y is up, so -z is north.
        east, north = (x + by[0], by[1] - z) if name in moved else (x, -z)
        longitude = LONGITUDE + east / (DEGREE * np.cos(np.radians(LATITUDE)))
        tag(scene, name, place=(LATITUDE + north / DEGREE, longitude, 500 + y))


def write_dates(scene, *dates):
    periods = [{"id": i, "date": date} for i, date in enumerate(dates)]
    scene.write("sparse/periods.json", json.dumps(periods))


def test_dates_in_order_are_silent(scene):
    tag_dates(scene, "2016-05-03", "2023-05-03")
    write_dates(scene, "2016", "2023-05")
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_period_order(scene):
    tag_dates(scene, "2023-05-03", "2016-05-03")
    scene.expect("CS221", place="period 1", found="2016-05-03")


def test_two_periods_of_one_day_have_no_order(scene):
    tag_dates(scene, "2023-05-03", "2023-05-03")
    assert {f.code for f in scene.validate().findings} == {"CS507"}


@pytest.mark.parametrize("date", ["2023-06-03", "2023-04-02", "2023-04", "2023-06"])
def test_photos_may_miss_a_stated_date_by_a_month(scene, date):
    tag_dates(scene, "2016-05-03", "2023-05-03")
    write_dates(scene, "2016-05", date)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


@pytest.mark.parametrize(
    "date", ["2020", "2023-07", "2023-06-04", "2023-04-01", "2023-03", "9999", "0001-01-01"]
)
def test_dates_against_periods_json(scene, date):
    tag_dates(scene, "2016-05-03", "2023-05-03")
    write_dates(scene, "2016-05", date)
    scene.expect("CS221", place="sparse/periods.json", found=date)


def test_photo_of_another_period(scene):
    tag_dates(scene, "2016-05-03", "2023-05-03")
    tag(scene, "a002.png", date="2023-05-01")
    scene.expect("CS222", place="images/a002.png", found="2023-05-01, the date of period 1")


def test_positions_that_fit_are_silent(scene):
    tag_places(scene)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


@pytest.mark.parametrize("count", [5, len(NAMES)])
@pytest.mark.parametrize("spread", [0.0, 2.0])
def test_photos_without_a_height_do_not_tilt_the_fit(scene, count, spread):
    tag_places(scene)
    for name in NAMES[:count]:
        path = scene.path(f"images/{name}")
        with Image.open(path) as image:
            image.load()
            exif = image.getexif()
        gps = dict(exif.get_ifd(0x8825))
        exif.get_ifd(0x8825).clear()
        exif.get_ifd(0x8825).update({tag: gps[tag] for tag in gps if tag not in (5, 6)})
        image.save(path, exif=exif)
    raw = RawScene(scene.root)
    raw.centres[:count, 1] += np.random.default_rng(0).uniform(-spread, spread, count)  # up
    fit = fit_gps(raw)
    assert fit.metres_from_world.scale == pytest.approx(METRES, rel=0.01)
    assert fit.distance.max() < 2


def test_photo_far_from_its_position(scene):
    tag_places(scene, moved=["a002.png"], by=(90.0, 40.0))
    scene.expect("CS223", place=f"{IMAGES} (a002.png)", found="a camera 9")


def test_whole_period_far_from_its_positions(scene):
    for i in range(5):  # the other period gets the majority
        scene.path(f"images/b{i:03d}.png").unlink()
    moved = ["b005.png", "b006.png"]
    for i in range(5):
        Image.fromarray(np.random.default_rng(i).integers(0, 256, (48, 64, 3), np.uint8)).save(
            scene.path(f"images/b{i:03d}.png")
        )
    tag_places_of(scene, [n for n in NAMES if n[0] == "a"] + moved, moved)
    scene.expect("CS223", place="period 1", found="2 of 2 cameras 141 m away")


def tag_places_of(scene, names, moved):
    tag_places(scene, moved=moved, by=(100.0, 100.0))
    for name in set(NAMES) - set(names):
        with Image.open(scene.path(f"images/{name}")) as image:
            image.load()
        image.save(scene.path(f"images/{name}"), exif=Image.Exif())


def test_a_position_without_a_hemisphere(scene):
    tag_places(scene)
    path = scene.path("images/a002.png")
    with Image.open(path) as image:
        image.load()
        exif = image.getexif()
    gps = dict(exif.get_ifd(0x8825))
    for missing in (1, 3):
        exif.get_ifd(0x8825).clear()
        exif.get_ifd(0x8825).update({tag: gps[tag] for tag in gps if tag != missing})
        image.save(path, exif=exif)
        scene.expect("CS229", place="images/a002.png", found="none")


def test_positions_that_do_not_fit_at_all(scene):
    rng = np.random.default_rng(3)
    for name in NAMES:
        north, east = rng.uniform(-0.01, 0.01, 2)
        tag(scene, name, place=(LATITUDE + north, LONGITUDE + east, 500.0))
    scene.expect("CS223", place=IMAGES, found="m (median)")


def test_focal_length_of_the_photos(scene):
    for name in NAMES:
        tag(scene, name, focal=28)  # 50 px on 64
    assert {f.code for f in scene.validate().findings} == {"CS507"}
    for name in NAMES:
        tag(scene, name, focal=85)
    scene.expect("CS224", place="(camera 1)", found="50 px")


def test_scale_by_positions(scene):
    tag_places(scene, metres=METRES)
    scene.write(WORLD, '{"unit": "metre"}')
    scene.expect("CS520", place=WORLD, found="per unit, by the GPS positions of 18 photos")
    tag_places(scene, metres=METRES)
    scene.write(WORLD, '{"unit": "unknown"}')
    assert {f.code for f in scene.validate().findings} == {"CS507"}


IMAGES, SPLIT, TEST = "sparse/0/images.txt", "sparse/split.txt", "sparse/0/test.txt"


def tag_date(scene, name, taken):
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
    for i in range(9):
        tag_date(scene, f"a{i:03d}.png", a.format(f"{i:02d}"))
        tag_date(scene, f"b{i:03d}.png", b.format(f"{i + 20:02d}"))


def rename(scene, a, b):
    """Give the images of the periods names like ``2016/x{}.png``."""
    for letter, form in (("a", a), ("b", b)):
        for i in range(9):
            old, new = f"{letter}{i:03d}.png", form.format(f"{i:03d}")
            scene.path(f"images/{new}").parent.mkdir(exist_ok=True)
            scene.path(f"images/{old}").rename(scene.path(f"images/{new}"))
            for place in (IMAGES, SPLIT, TEST):
                if old in scene.path(place).read_text():
                    scene.replace(place, old, new)


def test_a_date_of_no_period(scene):
    tag_all(scene, "2016:05:01 10:{}:00", "2023:05:01 10:{}:00")
    tag_date(scene, "a002.png", "2020:01:01 10:00:00")
    scene.expect("CS225", place="images/a002.png", found="2020-01-01")


def test_a_date_of_another_period_is_one_finding(scene):
    tag_all(scene, "2016:05:01 10:{}:00", "2023:05:01 10:{}:00")
    tag_date(scene, "a002.png", "2023:05:01 10:22:30")
    scene.expect("CS222", place="images/a002.png")


def test_visits_of_one_year_are_one_period(scene):
    tag_all(scene, "2016:03:01 10:{}:00", "2023:05:01 10:{}:00")
    tag_date(scene, "a002.png", "2016:08:01 10:00:00")
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
