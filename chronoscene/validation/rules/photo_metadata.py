"""CS22: what the photos say about themselves against what the scene says about them."""

from __future__ import annotations

from bisect import bisect
from collections.abc import Iterator
from datetime import date, datetime, timedelta
from itertools import pairwise

import numpy as np

from chronoscene.errors import ChronoSceneError
from chronoscene.formats.chronoscene import PERIODS, read_periods
from chronoscene.images.exif import ExifData
from chronoscene.io.wording import counted
from chronoscene.scene.geometry import rotation_from_quaternion
from chronoscene.validation.checks.gps_positions import GpsFit, fit_gps
from chronoscene.validation.finding import Hit
from chronoscene.validation.rule import rule
from chronoscene.validation.scene_folder import RawScene

FEWEST_DATES = 3
"""Photos with a date from which the median date of a period means something."""

DAY = timedelta(days=1)
"""Periods that are less apart may be mixed up by a time zone."""

MUCH_NEARER = 0.25
"""Share of the distance to its own period's date within which a photo is of another period."""

SLACK = 31
"""Days by which the photos may miss the date in ``periods.json``."""

DAYS = (365, 30, 0)
"""Days from the first to the last that a date with no, one and two hyphens stands for."""

GPS_FAR = 30.0
"""Metres; receivers in cameras and phones are good to about ten in the open."""

GPS_SIGMAS = 6.0
"""And so many standard deviations of the fit."""

GPS_LOOSE = 0.5
"""Standard deviation of the fit, as a share of the spread, beyond which nothing fits at all."""

MOST_UP = 0.9
"""Share of the cameras that look up where the model was turned over."""

FILM_DIAGONAL, FILM_WIDTH = 43.2666, 36.0
"""Millimetres; makers go by one or the other."""

FOCAL_RATIO = 1.4
"""Undistortion and cropping change the focal length by less."""


@rule(
    "CS221",
    "exif-period-order",
    "warning",
    what="The dates in the photos contradict the order of the periods, or `sparse/periods.json`.",
    remedy="number the periods by date, or correct the dates; if the cameras' clocks were wrong, "
    "ignore this rule",
    bad="the photos of period 0 are of 2023, those of period 1 of 2016",
    needs=("periods",),
)
def exif_period_order(scene: RawScene) -> Iterator[Hit]:
    medians = median_dates(scene)
    ordered = sorted(medians)
    for earlier, later in pairwise(ordered):
        if medians[earlier] - medians[later] >= DAY:
            expected = f"photos later than {medians[earlier]:%Y-%m-%d}, as of period {earlier}"
            found = f"{medians[later]:%Y-%m-%d} (median)"
            yield Hit(f"period {later}", expected, found)
    for period, stated in stated_dates(scene).items():
        first = date.fromisoformat(stated + "-01" * (2 - stated.count("-"))).toordinal()
        last_day = DAYS[stated.count("-")]
        if (
            period in medians
            and not -SLACK <= medians[period].toordinal() - first <= last_day + SLACK
        ):
            expected = f"the date of the photos of period {period}, {medians[period]:%Y-%m-%d}"
            yield Hit(PERIODS, expected, stated)


@rule(
    "CS222",
    "exif-other-period",
    "warning",
    what="The date in a photo is that of another period.",
    remedy="look at the photo; correct its period in split.txt",
    bad="a photo of 2023 among those of 2016",
    needs=("periods",),
)
def exif_other_period(scene: RawScene) -> Iterator[Hit]:
    for name, (taken, own, period) in of_other_period(scene).items():
        found = f"{taken:%Y-%m-%d}, as in period {period}"
        yield Hit(f"images/{name}", f"a date about {own:%Y-%m-%d}", found)


def of_other_period(scene: RawScene) -> dict[str, tuple[datetime, datetime, int]]:
    """Photos by name with the date of another period: date, date of their own, the other one."""
    wrong = {}
    medians = median_dates(scene)
    ordered = sorted((median, period) for period, median in medians.items())
    for name, taken in dates_of(scene).items():
        own = medians.get((scene.periods or {})[name])
        if own is None:
            continue
        at = bisect(ordered, (taken, 0))
        median, period = min(ordered[max(0, at - 1) : at + 1], key=lambda m: abs(m[0] - taken))
        if abs(median - own) >= DAY and abs(taken - median) < MUCH_NEARER * abs(taken - own):
            wrong[name] = (taken, own, period)
    return wrong


@rule(
    "CS223",
    "exif-position",
    "warning",
    what="The GPS position in a photo is far from its camera in the model, after the model was "
    "laid over the positions of all photos.",
    remedy="look at the pose: the photo may be registered in a wrong place that looks alike; if "
    "its receiver was wrong, ignore this rule",
    bad="a photo of the east facade that was matched to the west facade",
    needs=("cameras", "images"),
)
def exif_position(scene: RawScene) -> Iterator[Hit]:
    fit = fit_gps(scene)
    if fit is None:
        return
    if fit.sigma > max(GPS_LOOSE * fit.spread, GPS_FAR):
        found = f"{np.median(fit.distance):.3g} m between them (median)"
        yield Hit(scene.model_file("images"), "cameras where the photos' GPS has them", found)
        return
    if upside_down(scene, fit):
        found = "positions that only a mirrored or overturned model reaches: its cameras look up"
        todo = "check the signs of longitudes (east, west), and whether the model is mirrored"
        yield Hit(scene.model_file("images"), "cameras the right way up over GPS", found, todo)
    far = fit.distance > max(GPS_FAR, GPS_SIGMAS * fit.sigma)
    whole = _mostly_far(scene, fit, far)
    yield from whole.values()
    assert scene.images is not None
    for image, metres in zip(fit.images[far].tolist(), fit.distance[far], strict=True):
        if int(scene.image_periods[image]) not in whole:
            place = scene.image_place(scene.images.names[image])
            yield Hit(place, "a camera where its GPS has it", f"one {metres:.3g} m away")


def upside_down(scene: RawScene, fit: GpsFit) -> bool:
    """Whether the fit turned the model over, which it does where one of both is mirrored.

    Cameras look down, or to the horizon with their lower side down. In a mirrored plan that holds
    for a model on its head only.
    """
    assert scene.images is not None
    rotations = rotation_from_quaternion(scene.images.quaternions[fit.images])
    middle = rotations[:, 1] + rotations[:, 2]  # between forwards and down, in the world
    up = middle @ fit.metres_from_world.matrix[2]
    return bool(np.mean(up > 0) > MOST_UP)


def _mostly_far(scene: RawScene, fit: GpsFit, far: np.ndarray) -> dict[int, Hit]:
    """One hit for each period of which most photos are far, by the index of the period."""
    hits = {}
    periods = scene.image_periods[fit.images]
    for index, period in enumerate(scene.period_ids):
        mine = periods == index
        if (number := int(np.count_nonzero(far & mine))) > max(1, 0.5 * np.count_nonzero(mine)):
            metres = np.median(fit.distance[far & mine])
            found = f"{counted(number, 'camera')} of {np.count_nonzero(mine)} {metres:.3g} m away"
            hits[index] = Hit(f"period {period}", "cameras where GPS has them", found, count=number)
    return hits


@rule(
    "CS224",
    "exif-focal",
    "warning",
    what="The focal length of a camera contradicts the photos that were taken with it.",
    remedy="check the camera: in a scene with little relief COLMAP may settle on a wrong focal "
    "length; fix it to that of the photos and map again",
    bad="f = 4000 px with a width of 4000 px; the photos say 20 mm on 36 mm film (2222 px)",
    needs=("cameras", "images"),
)
def exif_focal(scene: RawScene) -> Iterator[Hit]:
    assert scene.images is not None
    stated: dict[int, list[float]] = {}
    pairs = zip(scene.images.names, scene.images.camera_ids.tolist(), strict=True)
    for name, camera_id in pairs:
        focal = scene.headers[name].exif.focal_35mm if name in scene.headers else None
        if focal is not None and camera_id in scene.usable_cameras:
            stated.setdefault(camera_id, []).append(focal)
    for camera_id, focals in stated.items():
        camera, film = scene.usable_cameras[camera_id], float(np.median(focals))
        long = max(camera.width, camera.height)
        low, high = sorted(
            [film * np.hypot(camera.width, camera.height) / FILM_DIAGONAL, film * long / FILM_WIDTH]
        )
        focal = float(camera.K[0, 0])
        if not low / FOCAL_RATIO <= focal <= high * FOCAL_RATIO:
            place = f"{scene.model_file('cameras')} (camera {camera_id})"
            expected = f"a focal length about {low:.4g} px ({film:.3g} mm on 36 mm film)"
            yield Hit(place, expected, f"{focal:.4g} px")


def dates_of(scene: RawScene) -> dict[str, datetime]:
    """When the images that have a period were taken."""
    headers = {n: scene.headers[n] for n in scene.periods or () if n in scene.headers}
    exif: dict[str, ExifData] = {name: header.exif for name, header in headers.items()}
    return {name: data.date for name, data in exif.items() if data.date is not None}


def median_dates(scene: RawScene) -> dict[int, datetime]:
    """Of the periods with enough dates."""
    by_period: dict[int, list[datetime]] = {}
    for name, taken in dates_of(scene).items():
        by_period.setdefault((scene.periods or {})[name], []).append(taken)
    return {
        period: sorted(dates)[len(dates) // 2]
        for period, dates in by_period.items()
        if len(dates) >= FEWEST_DATES
    }


def stated_dates(scene: RawScene) -> dict[int, str]:
    """Dates in ``periods.json`` by period; none where the file has its own finding."""
    ids = scene.period_ids
    if ids != list(range(len(ids))):
        return {}
    try:
        periods = read_periods(scene.root, len(ids))
    except ChronoSceneError:
        return {}
    return {period.id: period.date for period in periods if period.date is not None}
