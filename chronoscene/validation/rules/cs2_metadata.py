"""CS22: dates, positions and focal lengths in photos, and dates in names, against the scene."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator
from datetime import date, timedelta
from itertools import pairwise

import numpy as np

from chronoscene.colmap.raw_model import RawImages
from chronoscene.formats.chronoscene import PERIODS
from chronoscene.scene.grouping import grouped
from chronoscene.validation import rule
from chronoscene.validation.checks import photo_metadata
from chronoscene.validation.checks.photo_metadata import GpsFit, dates_of, of_other_period
from chronoscene.validation.folder.scene_folder import RawScene
from chronoscene.validation.rule import Hit

SLACK = 31  # Days by which the photos may miss the date in ``periods.json``

DAYS = (365, 30, 0)
"""Days from the first to the last that a date with no, one and two hyphens stands for."""

GPS_FAR = 30.0  # Metres; receivers in cameras and phones are accurate to about ten in the open
GPS_SIGMAS = 6.0  # Outliers are also this many standard deviations of the fit away

GPS_LOOSE = 0.5
"""Standard deviation of the fit, as a share of the spread, beyond which nothing fits at all."""

FILM_DIAGONAL, FILM_WIDTH = 43.2666, 36.0  # Millimetres; manufacturers refer to one or the other
FOCAL_RATIO = 1.4  # Undistortion and cropping change the focal length by less
MIN_PERIOD_DATES = 5  # Photos with a date from which one of them can be an outlier
MIN_APART = timedelta(days=183)  # Visits to a place that form one period may be months apart

APART_RATIO = 10.0
"""An outlier is also this many times as far from the median date as three quarters of the
photos."""

PURE = 0.9  # Share of the images whose period must be that of most images in their group
MIN_GROUP = 3  # Images of a group from which a majority is meaningful
MIN_WITH_YEAR = 0.9  # Share of the images of a period whose names must have one year in common

_BEGIN = re.compile(
    r"(?:p|t|day|date|time|epoch|period|visit)[-_]?\d+(?=[-_.])|(?:19[89]|20[0-4])\d(?:-?\d\d){0,2}(?!\d)",
    re.IGNORECASE,
)


@rule.warning(
    "CS221",
    bad="the photos of period 0 are from 2023, those of period 1 from 2016",
    remedy="number the periods by date, or correct the dates; if the clocks of the cameras were "
    "wrong, ignore this rule",
    needs=("periods",),
)
def exif_period_order(scene: RawScene) -> Iterator[Hit]:
    """The dates of the photos contradict the order of the periods, or `sparse/periods.json`."""
    medians = photo_metadata.median_dates(scene)
    for earlier, later in pairwise(sorted(medians)):
        if medians[earlier] - medians[later] >= photo_metadata.DAY:
            before = f"{medians[earlier]:%Y-%m-%d}, the date of period {earlier}"
            found = f"{medians[later]:%Y-%m-%d} (median)"
            yield Hit(f"period {later}", f"photos later than {before}", found)
    for period, stated in photo_metadata.stated_dates(scene).items():
        if period not in medians:
            continue
        hyphens = stated.count("-")
        first = date.fromisoformat(stated + "-01" * (2 - hyphens)).toordinal()
        if not -SLACK <= medians[period].toordinal() - first <= DAYS[hyphens] + SLACK:
            expected = f"the date of the photos of period {period}, {medians[period]:%Y-%m-%d}"
            yield Hit(_dates_place(scene), expected, stated)


def _dates_place(scene: RawScene) -> str:
    """Return the file that has the dates of the periods, or the folder whose names have them."""
    chosen = scene.origin is not None and scene.origin.detected.period_by is not None
    in_names = scene.is_project and (chosen or not (scene.root / PERIODS).exists())
    return scene.period_place if in_names else PERIODS


@rule.warning(
    "CS222",
    bad="a photo of 2023 among those of 2016",
    remedy="look at the photo; correct its period",
    needs=("periods",),
)
def exif_other_period(scene: RawScene) -> Iterator[Hit]:
    """The date of a photo is that of another period."""
    for name, (taken, own, period) in of_other_period(scene).items():
        found = f"{taken:%Y-%m-%d}, the date of period {period}"
        yield Hit(f"images/{name}", f"a date around {own:%Y-%m-%d}", found)


@rule.warning(
    "CS223",
    bad="a photo of the east facade that was matched to the west facade",
    remedy="check the pose: the photo may have been registered at a similar-looking place; if its "
    "GPS receiver was wrong, ignore this rule",
    needs=("cameras",),
)
def exif_position(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """The GPS position of a photo is far from its camera in the model, after aligning the model
    with the positions of all photos."""
    fit = photo_metadata.fit_gps(scene)
    if fit is None:
        return
    if fit.sigma > max(GPS_LOOSE * fit.spread, GPS_FAR):
        found = f"a distance of {np.median(fit.distance):.3g} m (median)"
        yield Hit(scene.model_file("images"), "cameras at the GPS positions of the photos", found)
        return
    far = fit.distance > max(GPS_FAR, GPS_SIGMAS * fit.sigma)
    whole = _mostly_far(scene, fit, far)
    yield from whole.values()
    for image, metres in zip(fit.images[far].tolist(), fit.distance[far], strict=True):
        if int(scene.image_periods[image]) not in whole:
            place = scene.image_place(images.names[image])
            yield Hit(place, "a camera at its GPS position", f"a camera {metres:.3g} m away")


@rule.warning(
    "CS229",
    bad="a latitude of 48 degrees without `GPSLatitudeRef`, which is N or S",
    remedy="write the references: exiftool -GPSLatitudeRef=N -GPSLongitudeRef=E IMAGE, or S and W",
)
def exif_no_hemisphere(scene: RawScene) -> Iterator[Hit]:
    """The GPS position of a photo has no N or S, or no E or W, so it is not used."""
    for name, header in scene.headers.items():
        if header.exif.no_hemisphere:
            yield Hit(f"images/{name}", "a latitude with N or S, a longitude with E or W", "none")


def _mostly_far(scene: RawScene, fit: GpsFit, far: np.ndarray) -> dict[int, Hit]:
    """One hit for each period of which most photos are far away, by the index of the period."""
    hits = {}
    periods = scene.image_periods[fit.images]
    for index, period in enumerate(scene.period_ids):
        mine = periods == index
        total, number = int(np.count_nonzero(mine)), int(np.count_nonzero(far & mine))
        if number > max(1, 0.5 * total):
            found = f"{number} of {total} cameras {np.median(fit.distance[far & mine]):.3g} m away"
            expected = "cameras at their GPS positions"
            hits[index] = Hit(f"period {period}", expected, found, count=number)
    return hits


@rule.warning(
    "CS224",
    bad="f = 4000 px with a width of 4000 px; the photos say 20 mm on 36 mm film (2222 px)",
    remedy="check the camera: in a scene with little relief COLMAP may converge to a wrong focal "
    "length; run the mapper again with the focal length of the photos, not refined",
    needs=("cameras",),
)
def exif_focal(scene: RawScene, images: RawImages) -> Iterator[Hit]:
    """The focal length of a camera contradicts the photos taken with it."""
    focals = (
        (camera_id, scene.headers[name].exif.focal_35mm)
        for name, camera_id in zip(images.names, images.camera_ids.tolist(), strict=True)
        if name in scene.headers and camera_id in scene.usable_cameras
    )
    stated = grouped((camera_id, focal) for camera_id, focal in focals if focal is not None)
    for camera_id, given in stated.items():
        camera, film = scene.usable_cameras[camera_id], float(np.median(given))
        by_diagonal = np.hypot(camera.width, camera.height) / FILM_DIAGONAL
        by_width = max(camera.width, camera.height) / FILM_WIDTH
        low, high = sorted([film * by_diagonal, film * by_width])
        focal = float(camera.K[0, 0])
        if not low / FOCAL_RATIO <= focal <= high * FOCAL_RATIO:
            expected = f"a focal length around {low:.4g} px ({film:.3g} mm on 36 mm film)"
            yield Hit(scene.camera_place(camera), expected, f"{focal:.4g} px")


@rule.warning(
    "CS225",
    bad="a photo of 2019 among those of May 2016, in a scene of 2016 and 2023",
    remedy="look at the photo: there may be no period for its date; if the clock of its camera "
    "was wrong, ignore this rule",
)
def exif_date_alone(scene: RawScene, periods: dict[str, int]) -> Iterator[Hit]:
    """The date of a photo is half a year or more from the other dates of its period, and is not
    that of any other period."""
    by_period = grouped((periods[name], (name, taken)) for name, taken in dates_of(scene).items())
    elsewhere = of_other_period(scene)
    for dates in map(dict, by_period.values()):
        if len(dates) < MIN_PERIOD_DATES:
            continue
        middle = sorted(dates.values())[len(dates) // 2]
        away = sorted(abs(taken - middle) for taken in dates.values())
        limit = max(MIN_APART, APART_RATIO * away[3 * len(away) // 4])
        for name, taken in dates.items():
            if abs(taken - middle) > limit and name not in elsewhere:
                expected = f"a date around {middle:%Y-%m-%d}"
                yield Hit(f"images/{name}", expected, f"{taken:%Y-%m-%d}")


@rule.warning(
    "CS227",
    bad="images in `2023/` in period 0, those in `2016/` in period 1",
    remedy="number the periods by date",
    needs=("periods",),
)
def names_period_order(scene: RawScene) -> Iterator[Hit]:
    """The years in the image names, or the dates in `sparse/periods.json`, contradict the order of
    the periods."""
    known = photo_metadata.median_dates(scene)  # their stated dates are compared by CS221
    stated = {p: d for p, d in photo_metadata.stated_dates(scene).items() if p not in known}
    for earlier, later in pairwise(sorted(stated)):
        digits = min(len(stated[earlier]), len(stated[later]))  # dates of different precision
        if stated[earlier][:digits] > stated[later][:digits]:
            expected = f"a date after {stated[earlier]}, the date of period {earlier}"
            yield Hit(f"{_dates_place(scene)} (period {later})", expected, stated[later])
    years = _years(scene)
    for earlier, later in pairwise(sorted(years)):
        if years[earlier] > years[later]:
            expected = f"names with a year after {years[earlier]}, the year of period {earlier}"
            yield Hit(f"period {later}", expected, str(years[later]))


def _years(scene: RawScene) -> dict[int, int]:
    """The year that nearly all names of a period contain, by period."""
    names = grouped((period, name) for name, period in (scene.periods or {}).items())
    years = {}
    for period, group in names.items():
        found = Counter(year for name in group for year in {_year(name)} if year is not None)
        year, times = max(found.items(), key=lambda item: item[1], default=(0, 0))
        if times >= MIN_WITH_YEAR * len(group):
            years[period] = year
    return years


def _year(name: str) -> int | None:
    """The first year in a name, also at the beginning of a date without hyphens."""
    year, month_and_day = r"(?<!\d)((?:19[89]|20[0-4])\d)", r"(?:0\d|1[0-2])[0-3]\d(?!\d)"
    found = re.search(rf"{year}(?:(?!\d)|(?={month_and_day}))", name)
    return int(found[1]) if found else None


@rule.warning(
    "CS228",
    bad="`2016/a.jpg` in period 1, all other images of `2016/` in period 0",
    remedy="look at the image; correct its period",
)
def names_other_period(scene: RawScene, periods: dict[str, int]) -> Iterator[Hit]:
    """The folders of the images, or the dates or period numbers that their names begin with, match
    the periods, except for a few images."""
    groups = grouped((_folder_or_begin(name), name) for name in periods)
    usual = {
        key: Counter(periods[name] for name in names).most_common(1)[0]
        for key, names in groups.items()
        if key is not None and len(names) >= MIN_GROUP
    }
    total = sum(len(groups[key]) for key in usual)
    if len({period for period, _ in usual.values()}) < 2:
        return
    if sum(number for _, number in usual.values()) < PURE * total:
        return
    for key, (period, _) in usual.items():
        for name in groups[key]:
            if periods[name] != period:
                expected = f"period {period}, as for the other images with {key!r}"
                yield Hit(f"{scene.period_place} ({name})", expected, f"period {periods[name]}")


def _folder_or_begin(name: str) -> str | None:
    """Return the folder or the beginning of a name, which images of a period may share."""
    folder, _, file = name.rpartition("/")
    begin = _BEGIN.match(file)
    return f"{folder}/" if folder else begin[0] if begin else None
