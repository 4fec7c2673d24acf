"""Which GPS positions of photos deserve belief, and the local frame around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.geodesy import Georeference, HeightKind, median_longitude
from chronoscene.registration.photos.photo import Capture

GROSS_FACTOR = 20.0
"""A position this many times farther from the median than the median distance is wrong, whatever
the route says; nearer ones are judged when there are poses to compare with."""

GROSS_METRES = 200.0
"""Nothing nearer to the median than this is called wildly wrong."""

CONSTANT_METRES = 0.5
"""Positions that all lie within this radius say nothing about the motion of the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """What the photos say about where they were taken, in a frame if there is one."""

    georeference: Georeference | None
    """None without at least three photos with positions that differ."""
    enu: NDArray[np.float64]
    """NaN where a photo has none. [N, 3]"""
    sigma: NDArray[np.float64]
    """Standard deviation, metres, NaN where there is none. [N, 3]"""
    believed: NDArray[np.bool_]
    """Not missing, not wildly wrong. [N]"""
    remarks: tuple[str, ...]
    """What was found out, for the log."""


def locate(captures: Sequence[Capture], frame: Georeference | None = None) -> Positions:
    """Put the positions of captures into one local frame.

    Wildly wrong positions (kilometres off among hundreds of metres, or another continent) are
    found by their distance from the median; subtler errors are left to the comparison with poses.

    Args:
        captures: Photos of all periods.
        frame: The frame to use; None for one around the median position.
    """
    count = len(captures)
    nothing = np.full((count, 3), np.nan)
    none = np.zeros(count, bool)
    has = np.array([c.gps is not None for c in captures], bool)
    if has.sum() < 3:
        remark = f"{int(has.sum())} of {count} photos have a GPS position: too few for a frame"
        return Positions(None, nothing, nothing, none, (remark,))
    latitude, longitude = (np.full(count, np.nan) for _ in range(2))
    for i in np.flatnonzero(has).tolist():
        gps = captures[i].gps
        assert gps is not None
        latitude[i], longitude[i] = gps.latitude, gps.longitude
    height, kind, remarks = _heights(captures, has)
    frame = frame or Georeference(
        latitude=round(float(np.nanmedian(latitude)), 7),
        longitude=round(median_longitude(longitude[has]), 7),
        height=round(float(np.median(height[has])), 2),
        height_kind=kind,
    )
    enu = nothing.copy()
    enu[has] = frame.to_enu(latitude[has], longitude[has], height[has])
    believed, more = _plausible(captures, enu, has)
    remarks += more
    sigma = np.stack([_sigma(c, kind) for c in captures])
    spread = np.ptp(enu[believed], axis=0) if believed.any() else np.zeros(3)
    if believed.sum() < 3 or spread.max() < CONSTANT_METRES:
        remarks.append(
            f"all GPS positions lie within {CONSTANT_METRES} m: one fix for all photos, of no use"
        )
        return Positions(None, nothing, nothing, none, tuple(remarks))
    remarks.insert(0, f"{int(has.sum())} of {count} photos have a GPS position; frame {frame.crs}")
    return Positions(frame, enu, sigma, believed, tuple(remarks))


def _heights(
    captures: Sequence[Capture], has: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], HeightKind, list[str]]:
    """One kind of height for all photos: mixing kinds would tilt or tear the frame."""
    count = len(captures)
    stated, relative = np.full(count, np.nan), np.full(count, np.nan)
    for i in np.flatnonzero(has).tolist():
        gps = captures[i].gps
        assert gps is not None
        stated[i] = np.nan if gps.altitude is None else gps.altitude
        relative[i] = np.nan if gps.relative_altitude is None else gps.relative_altitude
    if np.isfinite(stated[has]).all():
        return stated, "as stated", []
    if np.isfinite(relative[has]).all():
        return relative, "relative", ["heights are those above take-off: no others are stated"]
    known = np.isfinite(stated)
    if known.sum() >= 0.5 * has.sum():
        filled = np.where(known, stated, np.nanmedian(stated))
        missing = int((has & ~known).sum())
        return filled, "as stated", [f"{missing} photos state no height and get the median"]
    return np.zeros(count), "none", ["most photos state no height: all are taken as 0"]


def _plausible(
    captures: Sequence[Capture], enu: NDArray[np.float64], has: NDArray[np.bool_]
) -> tuple[NDArray[np.bool_], list[str]]:
    """Which positions are not wildly wrong, and the names of the others."""
    distance = np.linalg.norm(enu[:, :2] - np.median(enu[has][:, :2], axis=0), axis=1)
    limit = max(GROSS_METRES, GROSS_FACTOR * float(np.median(distance[has])))
    wild = has & ~(np.nan_to_num(distance, nan=0.0) <= limit)
    remarks = [
        f"{captures[i].name}: GPS is {distance[i] / 1000:.1f} km from the others: not believed"
        for i in np.flatnonzero(wild).tolist()
    ]
    return has & ~wild, remarks


def _sigma(capture: Capture, kind: HeightKind) -> NDArray[np.float64]:
    """Standard deviations east, north, up, in metres."""
    if capture.gps is None:
        return np.full(3, np.nan)
    sigma = np.array(capture.gps.sigma)
    if kind == "none":
        sigma[2] = max(sigma[2], 100.0)
    return sigma
