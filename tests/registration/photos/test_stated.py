"""Focal length, height, heading and accuracy that photos state."""

from pathlib import Path

import pytest

from chronoscene.images.exif import DroneData, ExifData
from chronoscene.registration.photos.photo import GPS_SIGMA, Capture, gps_sigma
from chronoscene.registration.photos.stated import contradicts, stated


def capture(exif: ExifData, size: tuple[int, int] = (1000, 750)) -> Capture:
    return Capture("a.jpg", Path("a.jpg"), 0, *size, exif, None, None)


def test_the_most_precise_focal_length_counts() -> None:
    calibrated = DroneData(calibrated_focal=3666.0)
    exif = ExifData(
        focal_mm=8.8, focal_35mm=24, focal_plane=400.0, width=4000, height=3000, drone=calibrated
    )
    assert stated(capture(exif)).focal == pytest.approx(3666.0 / 4)  # the photo was resized
    film = stated(capture(ExifData(focal_mm=8.8, focal_35mm=24, focal_plane=400.0)))
    assert film.focal == pytest.approx(24 / 35 * 1000)
    assert film.focal_error > stated(capture(exif)).focal_error
    plane = stated(capture(ExifData(focal_mm=8.8, focal_plane=400.0, width=4000, height=3000)))
    assert plane.focal == pytest.approx(8.8 * 400 / 4)


def test_a_turned_photo_was_not_cropped_but_one_of_another_shape_was() -> None:
    exif = ExifData(focal_35mm=28, width=4000, height=3000)
    assert stated(capture(exif, (750, 1000))).focal == pytest.approx(800)
    assert stated(capture(exif, (1000, 560))).focal is None


def test_contradiction_begins_at_five_percent_beyond_the_error() -> None:
    assert contradicts(1481, 1960, 0.005)
    assert not contradicts(2046, 1960, 0.005)
    assert not contradicts(1481, 1400, 0.01)


def position(**values: object) -> ExifData:
    return ExifData(latitude=51.0, longitude=11.0, **values)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("exif", "sigma"),
    [
        (position(), GPS_SIGMA),
        (position(drone=DroneData(rtk_std=(0.0113, 0.03, 0.0246))), (0.02, 0.03, 0.03)),
        (position(drone=DroneData(rtk_flag=50)), (0.02, 0.02, 0.03)),
        (position(drone=DroneData(rtk_flag=34)), (0.5, 0.5, 0.8)),
        (position(drone=DroneData(rtk_flag=16)), GPS_SIGMA),
        (position(gps_error=65.0), (65.0, 65.0, 130.0)),
        (position(gps_error=0.1), (1.0, 1.0, 2.0)),
        (position(gps_dop=2.0), (6.0, 6.0, 12.0)),
        (position(gps_error=5e6, gps_dop=1e9), GPS_SIGMA),
    ],
)
def test_accuracy_of_a_position(exif: ExifData, sigma: tuple[float, ...]) -> None:
    assert gps_sigma(exif) == pytest.approx(sigma)
