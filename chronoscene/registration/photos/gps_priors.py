"""Plausible GPS positions of photos, in a local frame around them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.geodesy import Georeference, HeightKind, median_longitude
from chronoscene.io.wording import counted
from chronoscene.registration.photos.photo import Capture

GROSS_FACTOR = 20.0
"""A position farther from the median position than this many times the median distance is wrong.
Nearer ones are judged once there are poses to compare with."""

GROSS_METRES = 200.0  # No position nearer to the median position is a gross error

MOST = 0.8
"""Share of the photos of a period that state both heights, from which take-off has a height."""

CONSTANT_METRES = 0.5
"""Positions that all lie within this distance do not describe the motion of the camera."""


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """GPS positions of the photos in a local frame."""

    georeference: Georeference | None
    """None unless at least three photos have different positions."""
    enu: Array
    """NaN where a photo has none. [N, 3]"""
    sigma: Array
    """Standard deviation, metres, NaN where there is none. [N, 3]"""
    plausible: Mask
    """Neither missing nor a gross error. [N]"""
    remarks: tuple[str, ...]
    """For the log."""


def locate(captures: Sequence[Capture], frame: Georeference | None = None) -> Positions:
    """Transform the GPS positions of captures into one local frame.

    Gross errors (kilometres among hundreds of metres, or another continent) are found by their
    distance from the median; smaller ones are left to the comparison with poses.

    Args:
        captures: Photos of all periods.
        frame: The frame to use; None for one around the median position.
    """
    count = len(captures)
    nothing = np.full((count, 3), np.nan)
    none = np.zeros(count, bool)
    has = np.array([c.gps is not None for c in captures], bool)
    if has.sum() < 3:
        remark = (
            f"{int(has.sum())} of {count} photos have a GPS position: too few to define a frame"
        )
        return Positions(None, nothing, nothing, none, (remark,))
    latitude, longitude = (_stated(captures, name) for name in ("latitude", "longitude"))
    height, kind, remarks = _heights(captures, has)
    frame = frame or Georeference(
        latitude=round(float(np.nanmedian(latitude)), 7),
        longitude=round(median_longitude(longitude[has]), 7),
        height=round(float(np.median(height[has])), 2),
        height_kind=kind,
    )
    enu = nothing.copy()
    enu[has] = frame.to_enu(latitude[has], longitude[has], height[has])
    plausible, more = _plausible(captures, enu, has)
    remarks += more
    sigma = np.stack([_sigma(c, kind) for c in captures])
    spread = np.ptp(enu[plausible], axis=0) if plausible.any() else np.zeros(3)
    if plausible.sum() < 3 or spread.max() < CONSTANT_METRES:
        remarks.append(
            f"{int(plausible.sum())} of {count} photos have a plausible GPS position: too few to "
            "define a frame"
            if plausible.sum() < 3
            else f"all GPS positions lie within {CONSTANT_METRES} m: they do not describe the "
            "motion of the camera"
        )
        return Positions(None, nothing, nothing, none, tuple(remarks))
    remarks.insert(0, f"{int(has.sum())} of {count} photos have a GPS position; frame {frame.crs}")
    return Positions(frame, enu, sigma, plausible, tuple(remarks))


def _stated(captures: Sequence[Capture], name: str) -> Array:
    """Collect a field of the GPS of each photo; NaN where there is none. [N]"""
    return np.array([getattr(c.gps, name, None) for c in captures], np.float64)


def _heights(captures: Sequence[Capture], has: Mask) -> tuple[Array, HeightKind, list[str]]:
    """Choose one kind of height for all photos: mixing kinds would tilt or distort the frame."""
    stated, relative = (_stated(captures, name) for name in ("altitude", "relative_altitude"))
    known = np.isfinite(stated)
    missing = int((has & ~known).sum())
    filled = _fill(stated, relative, has, np.array([c.period for c in captures]))
    remarks = []
    if given := int((np.isfinite(filled) & ~known).sum()):
        remarks = [f"{counted(given, 'height')} above take-off made absolute by the other photos"]
    if np.isfinite(filled[has]).all():
        return filled, "as stated", remarks
    if np.isfinite(relative[has]).all():
        remark = f"heights are relative to take-off: {missing} photos state no others"
        return relative, "relative", [remark]
    if known.sum() >= 0.5 * has.sum():
        remarks.append(f"{missing - given} photos state no height: the median is used")
        filled = np.where(np.isfinite(filled), filled, np.nanmedian(stated))
        return filled, "as stated", remarks
    return np.zeros(len(captures)), "none", ["most photos state no height: 0 is used for all"]


def _fill(stated: Array, relative: Array, has: Mask, period: Ints) -> Array:
    """Absolute heights of photos with a relative one, where most of their period state both. [N]"""
    filled = stated.copy()
    for one in np.unique(period[has]):
        mine = has & (period == one)
        take_off = (stated - relative)[mine]
        both = np.isfinite(take_off)
        if both.mean() >= MOST:
            absolute = relative + np.median(take_off[both])
            filled = np.where(mine & ~np.isfinite(stated), absolute, filled)
    return filled


def _plausible(captures: Sequence[Capture], enu: Array, has: Mask) -> tuple[Mask, list[str]]:
    """Mask of the positions without gross errors, and remarks on the others."""
    distance = np.linalg.norm(enu[:, :2] - np.median(enu[has][:, :2], axis=0), axis=1)
    limit = max(GROSS_METRES, GROSS_FACTOR * float(np.median(distance[has])))
    wild = has & ~(np.nan_to_num(distance, nan=0.0) <= limit)
    remarks = [
        f"{captures[i].name}: GPS is {distance[i] / 1000:.1f} km from the others: not used"
        for i in np.flatnonzero(wild).tolist()
    ]
    return has & ~wild, remarks


def _sigma(capture: Capture, kind: HeightKind) -> Array:
    """Standard deviations of a position east, north and up, in metres."""
    if capture.gps is None:
        return np.full(3, np.nan)
    sigma = np.array(capture.gps.sigma)
    if kind == "none":
        sigma[2] = max(sigma[2], 100.0)
    return sigma
