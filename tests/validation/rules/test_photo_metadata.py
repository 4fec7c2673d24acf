import json

import numpy as np
import pytest
from PIL import Image

from chronoscene.validation.scene_folder import RawScene

IMAGES, WORLD = "sparse/0/images.txt", "sparse/world.json"
NAMES = [f"{p}{i:03d}.png" for p in "ab" for i in range(7)]
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
    assert {f.code for f in scene.validate().findings} == {"CS226", "CS507"}


@pytest.mark.parametrize("date", ["2020", "2023-07", "2023-09-01", "9999", "0001-01-01"])
def test_dates_against_periods_json(scene, date):
    tag_dates(scene, "2016-05-03", "2023-05-03")
    write_dates(scene, "2016-05", date)
    scene.expect("CS221", place="sparse/periods.json", found=date)


def test_photo_of_another_period(scene):
    tag_dates(scene, "2016-05-03", "2023-05-03")
    tag(scene, "a002.png", date="2023-05-01")
    scene.expect("CS222", place="images/a002.png", found="2023-05-01, as in period 1")


def test_positions_that_fit_are_silent(scene):
    tag_places(scene)
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_photo_far_from_its_position(scene):
    tag_places(scene, moved=["a002.png"], by=(90.0, 40.0))
    scene.expect("CS223", place=f"{IMAGES} (a002.png)", found="one 9")


def test_whole_period_far_from_its_positions(scene):
    for i in range(5):  # the other period gets the majority
        scene.path(f"images/b{i:03d}.png").unlink()
    moved = ["b005.png", "b006.png"]
    for i in range(5):
        Image.fromarray(np.random.default_rng(i).integers(0, 256, (48, 64, 3), np.uint8)).save(
            scene.path(f"images/b{i:03d}.png")
        )
    tag_places_of(scene, [n for n in NAMES if n[0] == "a"] + moved, moved)
    scene.expect("CS223", place="period 1", found="2 cameras of 2 141 m away")


def tag_places_of(scene, names, moved):
    tag_places(scene, moved=moved, by=(100.0, 100.0))
    for name in set(NAMES) - set(names):
        with Image.open(scene.path(f"images/{name}")) as image:
            image.load()
        image.save(scene.path(f"images/{name}"), exif=Image.Exif())


def test_positions_that_do_not_fit_at_all(scene):
    rng = np.random.default_rng(3)
    for name in NAMES:
        north, east = rng.uniform(-0.01, 0.01, 2)
        tag(scene, name, place=(LATITUDE + north, LONGITUDE + east, 500.0))
    scene.expect("CS223", place=IMAGES, found="m between them (median)")


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
    scene.expect("CS520", place=WORLD, found="for one unit, by the GPS of 14 photos")
    tag_places(scene, metres=METRES)
    scene.write(WORLD, '{"unit": "unknown"}')
    assert {f.code for f in scene.validate().findings} == {"CS507"}


def test_longitudes_without_their_sign(scene):
    """West read as east: the plan is mirrored, and heights do not count."""
    tag_places(scene)
    for name in NAMES:
        path = scene.path(f"images/{name}")
        with Image.open(path) as image:
            image.load()
            exif = image.getexif()
        exif.get_ifd(0x8825)[3] = "W"
        image.save(path, exif=exif)
    scene.expect("CS223", place=IMAGES, found="a mirrored or overturned model")
