"""Metadata of photos: what is there is read, what is damaged or absurd is None."""

import io
import struct
from datetime import datetime
from math import isfinite

import pytest
from hypothesis import given
from hypothesis import strategies as st
from PIL import Image

from chronoscene.images.exif import DroneData, ExifData, exif_of, read_exif, set_upright

XMP = """<x:xmpmeta xmlns:x="adobe:ns:meta/"><rdf:Description
 drone-dji:AbsoluteAltitude="+132.50" drone-dji:RelativeAltitude="+61.30"
 drone-dji:GimbalYawDegree="-93.10" drone-dji:GimbalPitchDegree="-89.90"
 drone-dji:GimbalRollDegree="+0.00" drone-dji:RtkFlag="50" drone-dji:RtkStdLon="0.0113"
 drone-dji:RtkStdLat="0.0107" drone-dji:RtkStdHgt="0.0246"/></x:xmpmeta>"""

ELEMENTS = """<rdf:Description><drone-dji:RelativeAltitude>+61.30</drone-dji:RelativeAltitude>
<drone-dji:RtkStdLon>nonsense</drone-dji:RtkStdLon></rdf:Description>"""

pytestmark = pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, on damaged tags


def photo(form="JPEG", *, main=(), exif=(), gps=(), xmp=None):
    """A file with tags, as bytes."""
    tags = Image.Exif()
    tags[0x010F] = "Maker"
    tags.update(dict(main))
    tags.get_ifd(0x8769).update(dict(exif))
    tags.get_ifd(0x8825).update(dict(gps))
    options = {} if xmp is None else {"xmp": xmp if isinstance(xmp, bytes) else xmp.encode()}
    Image.new("RGB", (64, 48)).save(file := io.BytesIO(), form, exif=tags, **options)
    return file.getvalue()


def read(data):
    with Image.open(io.BytesIO(data)) as image:
        return exif_of(image)


FULL = {
    "main": {0x0110: "Model X", 0x0112: 6},
    "exif": {0x9003: "2016:05:03 12:30:00", 0x920A: 8.8, 0xA405: 24, 0xA002: 4000, 0xA003: 3000},
    "gps": {1: "S", 2: (33, 51, 24.12), 3: "W", 4: (70, 30, 0.0), 5: b"\1", 6: 12.5},
}


@pytest.mark.parametrize("form", ["JPEG", "PNG", "WEBP"])
def test_all_tags(form):
    data = read(photo(form, **FULL))
    assert data.date == datetime(2016, 5, 3, 12, 30)
    assert data.latitude == pytest.approx(-(33 + 51 / 60 + 24.12 / 3600), abs=1e-6)
    assert data.longitude == pytest.approx(-70.5) and data.has_position
    assert data.altitude == -12.5
    assert data.focal_mm == pytest.approx(8.8) and data.focal_35mm == 24
    assert (data.make, data.model, data.orientation) == ("Maker", "Model X", 6)
    assert (data.width, data.height) == (4000, 3000)
    assert data.drone is None


@pytest.mark.parametrize(("reference", "sign"), [(0, 1), (1, -1), (2, 1), (3, -1)])
def test_altitudes_below_the_sea_and_below_the_ellipsoid(reference, sign):
    gps = FULL["gps"] | {5: bytes([reference])}
    assert read(photo(gps=gps)).altitude == sign * 12.5


def test_tags_of_a_tiff():
    data = read(photo("TIFF", main=FULL["main"]))
    assert (data.make, data.model, data.orientation) == ("Maker", "Model X", 6)


def test_drone():
    drone = read(photo(xmp=XMP)).drone
    std = (0.0113, 0.0107, 0.0246)
    assert drone == DroneData(61.3, std, rtk_flag=50, heading=-93.1)


def test_calibration_and_accuracy_by_other_makers():
    pix4d = b'<d Camera:GPSXYAccuracy="0.015" Camera:GPSZAccuracy="0.03" '
    dewarp = b'drone-dji:DewarpData="2018-10-19;3678.87,3671.84,10.1,27.2,-0.26" />'
    assert read(photo(xmp=pix4d + dewarp)).drone == DroneData(
        rtk_std=(0.015, 0.015, 0.03), calibrated_focal=3678.87
    )
    older = read(photo(xmp=b'<d drone-dji:CalibratedFocalLength="3666.666" />')).drone
    assert older == DroneData(calibrated_focal=3666.666)


def test_focal_plane_error_and_heading():
    exif = {0xA20E: 4865.6, 0xA210: 2}
    data = read(photo(exif=exif, gps=FULL["gps"] | {31: 6.0, 11: 2.5, 16: "T", 17: 359.2}))
    assert data.focal_plane == pytest.approx(4865.6 / 25.4)
    assert (data.gps_error, data.gps_dop, data.heading) == (6.0, 2.5, pytest.approx(359.2))
    magnetic = read(photo(gps=FULL["gps"] | {16: "M", 17: 359.2}))
    assert magnetic.heading is None


def test_drone_with_elements_and_damage():
    assert read(photo(xmp=ELEMENTS)).drone == DroneData(relative_altitude=61.3)


def test_other_xmp_is_no_drone():
    assert read(photo(xmp="<x:xmpmeta/>")).drone is None


def test_nothing(tmp_path):
    assert read_exif(tmp_path / "absent.jpg") == ExifData()
    (tmp_path / "text.jpg").write_text("hello")
    assert read_exif(tmp_path / "text.jpg") == ExifData()
    Image.new("RGB", (4, 4)).save(tmp_path / "a.png")
    assert read_exif(tmp_path / "a.png") == ExifData()


@pytest.mark.parametrize(
    "date",
    [
        "0000:00:00 00:00:00", "2016:13:01 00:00:00", "1980:01:01 00:00:00", "2107:12:31 23:59:58",
        "9999:12:31 23:59:59", "yesterday", "",
    ],
)  # fmt: skip
def test_dates_that_are_none(date):
    assert read(photo(exif={0x9003: date})).date is None
    gps = {1: "N", 2: (48, 0, 0), 3: "E", 4: (11, 0, 0), 7: (23, 59, 59), 29: date[:10]}
    data = read(photo(gps=gps))
    assert data.date is None and data.latitude == 48


def test_date_of_digitisation_where_there_is_no_other():
    assert read(photo(exif={0x9004: "2016-05-03T12:00:00"})).date == datetime(2016, 5, 3, 12)
    # The time of the last change by a program says nothing about the photo.
    assert read(photo(main={0x0132: "2016:05:03 12:00:00"})).date is None


@pytest.mark.parametrize(
    "gps",
    [
        {1: "N", 2: (0, 0, 0), 3: "E", 4: (0, 0, 0)},
        {1: "N", 2: (91, 0, 0), 3: "E", 4: (10, 0, 0)},
        {1: "N", 2: (48, 0, 0)},
    ],
)
def test_positions_that_are_none(gps):
    data = read(photo(gps=gps))
    assert not data.has_position and not data.no_hemisphere


@pytest.mark.parametrize(
    "references", [{}, {1: "S"}, {3: "W"}, {1: "", 3: "W"}, {1: "S", 3: "?"}, {1: "E", 3: "N"}]
)
def test_positions_without_a_hemisphere_are_none(references):
    data = read(photo(gps={2: (33, 51, 24.12), 4: (70, 30, 0.0)} | references))
    assert not data.has_position and data.no_hemisphere


@pytest.mark.parametrize(("status", "is_void"), [("V", True), ("A", False), ("", False)])
def test_a_position_without_a_fix_is_none(status, is_void):
    data = read(photo(gps={1: "N", 2: (48, 0, 0), 3: "E", 4: (11, 0, 0), 9: status}))
    assert data.is_void == is_void and data.has_position != is_void


@pytest.mark.parametrize(("north", "east"), [("n", "west"), ("North", "W\0")])
def test_hemispheres_in_other_spellings(north, east):
    data = read(photo(gps=FULL["gps"] | {1: north, 3: east}))
    assert (data.latitude, data.longitude) == (pytest.approx(33.85670), pytest.approx(-70.5))
    assert not data.no_hemisphere


def test_pixels_are_not_decoded(tmp_path):
    path = tmp_path / "a.png"
    Image.effect_noise((64, 48), 50).save(path)
    path.write_bytes(path.read_bytes()[:200])  # a header, and hardly any pixels
    assert read_exif(path) == ExifData()
    with Image.open(path) as image:
        exif_of(image)
        assert image.tile  # still to be decoded


def check(data):
    """Whatever is in the file, the result is of the right types and ranges."""
    try:
        found = read(data)
    except OSError:
        return  # not even an image
    assert found.latitude is None or -90 <= found.latitude <= 90
    assert found.longitude is None or -180 <= found.longitude <= 180
    assert found.orientation in range(1, 9)
    assert found.focal_mm is None or 0 < found.focal_mm < float("inf")
    assert found.make is None or (found.make.isprintable() and len(found.make) <= 100)


@given(st.integers(0, 500), st.binary(max_size=12))
def test_damaged_metadata(at, garbage):
    good = photo(xmp=XMP, **FULL)
    check(good[:at] + garbage + good[at + len(garbage) :])


@given(st.binary(max_size=200))
def test_any_tags(garbage):
    begin = b"Exif\0\0II*\0" + struct.pack("<I", 8)
    Image.new("RGB", (4, 4)).save(file := io.BytesIO(), "JPEG", exif=begin + garbage)
    check(file.getvalue())


@given(st.text(max_size=60))
def test_any_xmp(text):
    xmp = f'drone-dji:RelativeAltitude="{text}" drone-dji:RtkStdLon={text}'
    drone = read(photo(xmp=xmp.encode("utf-8", "surrogatepass"))).drone
    assert drone is None or drone.relative_altitude is None or isfinite(drone.relative_altitude)


@pytest.mark.parametrize(
    ("text", "date"),
    [
        ("2016:05:03 12:30:05.25", datetime(2016, 5, 3, 12, 30, 5)),
        ("2016:05:03 12:30:05+02:00", datetime(2016, 5, 3, 12, 30, 5)),
        ("2016-05-03T12:30:05Z", datetime(2016, 5, 3, 12, 30, 5)),
        ("2016/05/03 12:30", datetime(2016, 5, 3, 12, 30)),
        ("2016:5:3 9:5:0", datetime(2016, 5, 3, 9, 5)),
        ("2016:05:03", datetime(2016, 5, 3)),
        ("2016:05:03 24:00:00", datetime(2016, 5, 3)),
        ("2016:05:031 12:00:00", None),
    ],
)
def test_dates_as_programs_write_them(text, date):
    assert read(photo(exif={0x9003: text})).date == date


def test_date_of_the_gps_fix_where_there_is_no_other():
    gps = {29: "2016:05:03", 7: (9.0, 30.0, 15.5)}
    assert read(photo(gps=gps)).date == datetime(2016, 5, 3, 9, 30, 15, 500000)
    assert read(photo(gps=gps, exif={0x9003: "2017:05:03 12:00:00"})).date.year == 2017
    assert read(photo(gps={29: "2016:05:03", 7: (99.0, 0.0, 0.0)})).date == datetime(2016, 5, 3)


def tagged(orientation, order="<"):
    exif = Image.Exif()
    exif.endian = order
    exif[0x010F], exif[0x0112] = "Maker", orientation
    Image.new("RGB", (8, 8)).save(file := io.BytesIO(), "JPEG", exif=exif)
    return file.getvalue()


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("is_long", [False, True])
def test_upright(order, is_long):
    data = tagged(6, order)
    if is_long:  # as some programs write it
        entry = struct.pack(f"{order}HHI", 0x0112, 3, 1)
        assert data.count(entry) == 1
        long = struct.pack(f"{order}HHII", 0x0112, 4, 1, 6)
        at = data.index(entry)
        data = data[:at] + long + data[at + 12 :]
        assert exif_of(Image.open(io.BytesIO(data))).orientation == 6
    new = Image.open(io.BytesIO(set_upright(data)))
    assert new.getexif()[0x0112] == 1 and exif_of(new).make == "Maker"
    assert set_upright(set_upright(data)) is None


@given(st.binary(max_size=60), st.integers(0, 200))
def test_upright_changes_two_bytes_or_nothing(garbage, at):
    good = tagged(6)
    data = good[:at] + garbage + good[at + len(garbage) :]
    found = set_upright(data)
    if found is not None:
        assert len(found) == len(data)
        assert sum(a != b for a, b in zip(found, data, strict=True)) <= 2
