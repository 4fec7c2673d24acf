"""Dates of photos and of `sparse/periods.json`, and GPS positions of photos."""

from __future__ import annotations

from datetime import datetime, timedelta
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array, Mask
from chronoscene.errors import ChronoSceneError
from chronoscene.geodesy import Georeference, median_longitude
from chronoscene.scene.grouping import grouped
from chronoscene.scene.similarity import SIGMA, Similarity, fit_robustly
from chronoscene.validation.folder.scene_folder import RawScene, derived

MIN_DATES = 3  # Photos with a date from which the median date of a period is meaningful
DAY = timedelta(days=1)  # Periods less than this apart may be confused by a time zone

MUCH_NEARER = 0.25
"""A photo is of another period if its date is within this share of the distance to its own."""

MIN_PHOTOS = 6  # Photos with a position from which a similarity is meaningful
HEIGHT_ROUNDS = 10  # With heights of up to 0.6 of the spread, the scale is then within 0.1 %
MIN_SPREAD = 10.0  # Metres; smaller spreads of positions are the noise of the receiver


@derived
def dates_of(scene: RawScene) -> dict[str, datetime]:
    """Times of capture of the images that have a period."""
    dates = {n: scene.headers[n].exif.date for n in scene.periods or () if n in scene.headers}
    return {name: taken for name, taken in dates.items() if taken is not None}


@derived
def median_dates(scene: RawScene) -> dict[int, datetime]:
    """Median dates of the periods with enough dates."""
    periods = scene.periods or {}
    by_period = grouped((periods[name], taken) for name, taken in dates_of(scene).items())
    enough = {period: sorted(d) for period, d in by_period.items() if len(d) >= MIN_DATES}
    return {period: dates[len(dates) // 2] for period, dates in enough.items()}


@derived
def of_other_period(scene: RawScene) -> dict[str, tuple[datetime, datetime, int]]:
    """Photos with the date of another period: their date, that of their period, the other one."""
    wrong = {}
    medians = median_dates(scene)
    ordered = sorted((median, period) for period, median in medians.items())
    for name, taken in dates_of(scene).items():
        own = medians.get((scene.periods or {})[name])
        if own is None:
            continue
        median, period = min(ordered, key=lambda m: abs(m[0] - taken))
        if abs(median - own) >= DAY and abs(taken - median) < MUCH_NEARER * abs(taken - own):
            wrong[name] = (taken, own, period)
    return wrong


@derived
def stated_dates(scene: RawScene) -> dict[int, str]:
    """Dates of the periods in ``periods.json``; none if it is invalid, which has its own rule."""
    ids = scene.period_ids
    if ids != list(range(len(ids))):
        return {}
    try:
        periods = scene.period_table()
    except ChronoSceneError:
        return {}
    return {period.id: period.date for period in periods if period.date is not None}


class GpsFit(NamedTuple):
    """The similarity that aligns the model with the positions of N photos."""

    images: NDArray[np.int64]
    """Indices into the images. [N]"""
    metres_from_world: Similarity
    distance: NDArray[np.float64]
    """Horizontal metres between model and photo. [N]"""
    sigma: float
    """Robust standard deviation of `distance`."""
    spread: float
    """Median horizontal distance of the positions from their centre, in metres."""


@derived
def fit_gps(scene: RawScene) -> GpsFit | None:
    """Fit the camera centres to the positions of the photos; None if there are too few."""
    images = scene.images
    if images is None:
        return None
    rows, places = [], []
    for i, name in enumerate(images.names):
        exif = scene.headers[name].exif if name in scene.headers else None
        if exif is not None and exif.has_position and scene.is_posed[i]:
            rows.append(i)
            places.append((exif.latitude, exif.longitude, exif.altitude))
    if len(rows) < MIN_PHOTOS:
        return None
    latitude, longitude, altitude = np.array(places, np.float64).T
    unknown = ~np.isfinite(altitude)
    altitude[unknown] = 0.0 if unknown.all() else np.median(altitude[~unknown])
    middle = (float(np.median(latitude)), median_longitude(longitude), float(np.median(altitude)))
    target = Georeference(*middle, "as stated").to_enu(latitude, longitude, altitude)
    spread = float(np.median(np.linalg.norm(target[:, :2], axis=1)))
    found = _fit(scene.centres[rows], target, unknown) if spread >= MIN_SPREAD else None
    if found is None:
        return None
    sigma = SIGMA * float(np.median(found[1]))
    return GpsFit(np.array(rows, np.int64), found[0], found[1], sigma, spread)


def _fit(source: Array, target: Array, unknown: Mask) -> tuple[Similarity, Array] | None:
    """Fit positions, of which some have no height: it is guessed, then that of the fit before.

    Wrong heights would tilt the fit, and change its scale.

    Source: the algorithm of Green and Gower 1979 for a Procrustes problem with a projection.
    """
    found = fit_robustly(source, target, axes=2)
    for _ in range(HEIGHT_ROUNDS if unknown.any() else 0):
        if found is None:
            break
        target[unknown, 2] = found[0].apply(source)[unknown, 2]
        found = fit_robustly(source, target, axes=2)
    return found
