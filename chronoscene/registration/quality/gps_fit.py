"""Each period against its own GPS, the only measurement that does not depend on images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.arrays import Array, Mask
from chronoscene.scene.similarity import SIGMA, fit_robustly

MIN_POSITIONS = 4  # Positions that a period needs
NEIGHBOURS = 15
"""Cameras in one place whose median counts: more than half of them are hardly ever outliers."""

PART = 3  # Neighbouring cameras that make a part
NEAREST = 6  # Cameras in one place, for parts
ELSEWHERE = 30.0
"""Horizontal distance from a camera to its GPS, metres, that neighbouring photos hardly share by
errors of the receiver."""
ALIKE = 0.25
"""Distance between displacements of one part, relative to them."""

SPREAD_FACTOR = 3.0
"""The positions of a period must spread over this many times the error of the receiver."""


@dataclass(frozen=True, slots=True, eq=False)
class PeriodGpsFit:
    """Differences between the cameras of a period and their GPS positions, in metres."""

    positions: int
    median: float
    """Distance after the similarity that fits this period best."""
    local: float
    """Largest median of that distance over neighbouring cameras."""
    largest: float
    outliers: int
    """Positions off by more than three robust standard deviations."""
    scale: float | None
    """Scale of that similarity, GPS relative to model. None where the path is short."""
    scale_error: float | None
    """Standard deviation."""
    turn: float | None
    """Degrees about the vertical, by the same fit; positive is counter-clockwise from above."""
    turn_error: float | None
    offset: Array
    """Median of GPS minus camera as registered, east, north, up. [3]"""
    offset_error: Array
    """Standard deviation of that median, per axis. [3]"""


def fit_gps(centres: Array, gps: Array) -> PeriodGpsFit | str:
    """Compare cameras with GPS positions; the reason, where that is not possible.

    Args:
        centres: In the frame of the model, which is east, north, up in metres. [N, 3]
        gps: NaN where there is none, whether it is plausible or not. [N, 3]
    """
    has = np.isfinite(gps).all(axis=1)
    if has.sum() < MIN_POSITIONS:
        return f"fewer than {MIN_POSITIONS} images have a GPS position"
    source, target = centres[has], gps[has]
    fitted = fit_robustly(source, target)
    difference = target - source
    offset = np.median(difference, axis=0)
    width = SIGMA * np.median(np.abs(difference - offset), axis=0)
    # The median of n normal numbers varies 1.2533 times as much as their mean.
    error = 1.2533 * np.maximum(width, 0.01) / np.sqrt(has.sum())
    if fitted is None:
        return "the GPS positions lie in one place"
    distance = fitted[1]
    noise = max(float(np.median(distance)) / 1.5382, 0.01)
    scale, scale_error, turn, turn_error = _scale_and_turn(source, target, noise)
    return PeriodGpsFit(
        positions=int(has.sum()),
        median=float(np.median(distance)),
        local=_largest_local_median(source, distance),
        largest=float(distance.max()),
        outliers=int((distance > 3 * SIGMA * np.median(distance)).sum()),
        scale=scale,
        scale_error=scale_error,
        turn=turn,
        turn_error=turn_error,
        offset=offset,
        offset_error=error,
    )


def displaced_parts(centres: Array, gps: Array) -> Mask:
    """Find the cameras of parts of the model that GPS places elsewhere, all by one displacement.

    Gross errors of a receiver differ from photo to photo, unless it repeats an old position.

    Args:
        centres: In the frame of the model, which is east, north, up in metres. [N, 3]
        gps: NaN where there is none. [N, 3]
    """
    away = (gps - centres)[:, :2]
    distance = np.linalg.norm(away, axis=1)
    far = distance > ELSEWHERE
    count = min(NEAREST, len(centres))
    if count < PART or not far.any():
        return np.zeros(len(centres), bool)
    nearest = cKDTree(centres).query(centres, count)[1]
    apart = np.linalg.norm(away[nearest] - away[:, None], axis=2)
    alike = far[nearest] & (apart < ALIKE * distance[:, None])
    return far & (alike.sum(axis=1) >= PART)


def _largest_local_median(places: Array, values: Array) -> float:
    """Largest median over a place and its nearest ones."""
    count = min(NEIGHBOURS, len(places))
    nearest = cKDTree(places).query(places, count)[1].reshape(len(places), -1)
    return float(np.median(values[nearest], axis=1).max())


def _scale_and_turn(
    source: Array, target: Array, noise: float
) -> tuple[float | None, float | None, float | None, float | None]:
    """Horizontal similarity by reweighted least squares on complex numbers: target = m source + c.

    Heights are left out: those of consumer receivers are off by tens of metres between days.
    """
    z = source[:, 0] + 1j * source[:, 1]
    w = target[:, 0] + 1j * target[:, 1]
    weight = np.ones(len(z))
    factor = 1.0 + 0j
    for _ in range(10):
        zc = z - np.average(z, weights=weight)
        wc = w - np.average(w, weights=weight)
        power = float((weight * np.abs(zc) ** 2).sum())
        if power <= 0 or np.sqrt(power / weight.sum()) < SPREAD_FACTOR * noise:
            return None, None, None, None
        factor = (weight * zc.conj() * wc).sum() / power
        residual = np.abs(wc - factor * zc)
        width = max(float(np.median(residual)) / 1.1774, 0.01)
        weight = 1.0 / (1.0 + (residual / (2 * width)) ** 2)
    error = 1.1 * width / np.sqrt(power)
    angle = float(np.degrees(np.angle(factor)))
    size = abs(complex(factor))
    return float(size), float(error), angle, float(np.degrees(error / max(size, 1e-9)))
