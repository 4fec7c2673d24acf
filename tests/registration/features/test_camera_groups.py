"""Photos that share a camera."""

from datetime import datetime, timedelta
from pathlib import Path

from chronoscene.images.exif import ExifData
from chronoscene.registration.context import Calibration
from chronoscene.registration.features.camera_groups import MIN_PHOTOS, camera_groups
from chronoscene.registration.photos.photo import Capture


def capture(
    name: str, period: int, *, model: str = "A", focal: float = 24.0, taken: datetime | None = None
) -> Capture:
    exif = ExifData(make="maker", model=model, focal_mm=focal)
    return Capture(name, Path(name), period, 640, 480, exif, taken, None)


def names(captures: list[Capture], calibration: Calibration = "auto") -> list[list[str]]:
    return [group["names"] for group in camera_groups(captures, "SIMPLE_RADIAL", calibration)]


def test_lens_and_zoom_make_the_camera() -> None:
    mixed = [
        capture("a", 0),
        capture("b", 0, model="B"),
        capture("c", 0, focal=70.0),
        capture("d", 0),
    ]
    assert names(mixed) == [["a", "d"], ["b"], ["c"]]


def test_a_period_with_many_photos_has_its_own_calibration() -> None:
    many = [capture(f"0/{i}", 0) for i in range(MIN_PHOTOS)]
    more = [capture(f"1/{i}", 1) for i in range(MIN_PHOTOS)]
    assert names(many + more) == [sorted(c.name for c in many), sorted(c.name for c in more)]


def test_periods_with_few_photos_share_one() -> None:
    few = [capture("0/a", 0), capture("1/a", 1)]
    assert names(few) == [["0/a", "1/a"]]
    assert names(few, "per-period") == [["0/a"], ["1/a"]]


def test_periods_share_one_where_that_is_asked_for() -> None:
    many = [capture(f"{p}/{i}", p) for p in (0, 1) for i in range(MIN_PHOTOS)]
    assert names(many, "shared") == [sorted(c.name for c in many)]
    assert len(names([*many, capture("1/b", 1, model="B")], "shared")) == 2


def test_periods_of_one_visit_share_a_calibration() -> None:
    noon = datetime(2020, 5, 1, 12)
    minute, year = timedelta(minutes=1), timedelta(days=365)

    def photos(period: int, start: datetime) -> list[Capture]:
        return [
            capture(f"{period}/{i:02}", period, taken=start + i * minute) for i in range(MIN_PHOTOS)
        ]

    legs = photos(0, noon) + photos(1, noon + 40 * minute)
    later = photos(2, noon + year)
    assert names(legs + later) == [[c.name for c in legs], [c.name for c in later]]
    assert len(names(legs + later, "per-period")) == 3
