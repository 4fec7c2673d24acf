"""Uncertainty of differences between two periods: what cells have alone, and what they share.

Sources: Hoehle and Hoehle 2009 (NMAD, and quantiles as robust measures of errors that are not
normal); Rolstad, Haug and Denby 2009 (means over an area, with a spherical variogram).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array
from chronoscene.errors import SceneError
from chronoscene.io.documents import read_json_document
from chronoscene.registration.output import CERTIFICATE
from chronoscene.scene import Scene
from chronoscene.scene.similarity import SIGMA, median_and_nmad

CONFIDENCE = 1.96  # Standard deviations of a 95 % interval
ONE_SIGMA = 0.683  # Share of normal numbers within one standard deviation
MIN_STABLE = 1000  # Cells of stable ground from which a variogram is estimated
DEFAULT_RANGE = 10.0  # Cells; correlation length where they are fewer
_DISPLACEMENTS = ("displacement by held-out tracks", "displacement by held-out tracks and ties")


@dataclass(frozen=True, slots=True)
class StableGround:
    """Differences of elevations where nothing changed."""

    cells: int
    median: float
    """Metres."""
    nmad: float
    """Robust standard deviation: 1.4826 times the median absolute deviation."""
    length: float
    """Range of the spherical variogram in metres: differences farther apart are independent."""
    factor: float
    """Size of the differences in units of what the spreads of both periods give, by `excess`."""


@dataclass(frozen=True, slots=True)
class Registration:
    """Standard deviation of the alignment of two periods, in metres, which all cells share."""

    sigma: float
    source: str


def stable_ground(differences: Array, deviations: Array, resolution: float) -> StableGround:
    """Measure differences where nothing changed: those within 3 deviations of the median.

    Args:
        differences: Metres; NaN where unknown. [H, W]
        deviations: Standard deviations by the spreads of both periods. [H, W]
        resolution: Edge of a cell, metres.
    """
    known = np.isfinite(differences)
    if not known.any():
        return StableGround(0, 0.0, 0.0, DEFAULT_RANGE * resolution, 1.0)
    middle = float(np.median(differences[known]))
    factor = excess(differences[known] - middle, deviations[known])
    with np.errstate(invalid="ignore"):
        stable = known & (np.abs(differences - middle) <= 3 * factor * deviations)
    median, nmad = median_and_nmad(differences[stable])
    length = DEFAULT_RANGE
    if stable.sum() >= MIN_STABLE and nmad > 0:
        length = _correlation_length(np.where(stable, differences, np.nan) / nmad)
    return StableGround(int(stable.sum()), median, nmad, length * resolution, factor)


def excess(differences: Array, deviations: Array) -> float:
    """Return the 68.3 % quantile of ``|difference| / deviation``: 1 if deviations are right and
    nothing changed; changes of some of the places matter little."""
    ratio = np.abs(differences) / np.maximum(deviations, 1e-9)
    return float(np.quantile(ratio, ONE_SIGMA))


def _correlation_length(field: Array) -> float:
    """Fit a spherical variogram of sill 1 to a field with gaps; its range in cells. [H, W]"""
    farthest = max(2, min(field.shape) // 3)
    lags = np.unique(np.geomspace(1, farthest, 12).astype(int))
    found = []
    for lag in lags:
        steps = np.concatenate(
            [(field[lag:] - field[:-lag]).ravel(), (field[:, lag:] - field[:, :-lag]).ravel()]
        )
        steps = np.abs(steps[np.isfinite(steps)])
        found.append((SIGMA * np.median(steps)) ** 2 / 2 if len(steps) else np.nan)
    ranges = np.geomspace(1, farthest, 60)
    near = np.minimum(lags / ranges[:, None], 1)
    errors = np.nansum((1.5 * near - 0.5 * near**3 - found) ** 2, axis=1)
    return float(ranges[np.argmin(errors)])


def variance_of_mean(area: float, length: float, cells: int) -> float:
    """Variance of a mean over an area, in units of the variance of a cell.

    With L the radius of a circle of this area and a the range of the variogram, it is
    ``1 - L / a + (L / a)^3 / 5`` for L < a, else ``(a / L)^2 / 5``; 1 / n at least.
    """
    ratio = np.sqrt(area / np.pi) / length
    share = 1 - ratio + ratio**3 / 5 if ratio < 1 else 1 / (5 * ratio**2)
    return float(max(share, 1 / cells))


UNKNOWN = Registration(
    0.0, f"unknown, and left out: there is no {CERTIFICATE} of this pair, as register writes it"
)


def find_registration(
    scene: Scene, periods: tuple[int, int], stable: StableGround, area: float
) -> Registration:
    """Find how well two periods are aligned.

    By the certificate, it is the upper end of the 95 % interval of their displacement, over 1.96.
    Without one, it is what stable ground shows: the root of the squares of the median and of its
    standard deviation; 0 if there is no stable ground, either.

    Args:
        scene: Scene whose folder may hold a certificate.
        periods: Their numbers.
        stable: Stable ground of the two.
        area: Of the stable ground, square metres.

    Raises:
        SceneError: If the certificate is damaged.
    """
    if certified := certified_registration(scene, periods):
        return certified
    if not stable.cells:
        return UNKNOWN
    mean = stable.nmad**2 * variance_of_mean(area, stable.length, stable.cells)
    source = f"stable ground, as the scene has no {CERTIFICATE} of this pair"
    return Registration(float(np.sqrt(stable.median**2 + mean)), source)


def certified_registration(scene: Scene, periods: tuple[int, int]) -> Registration | None:
    """Return what the certificate of a scene says of a pair of periods; None if nothing.

    Raises:
        SceneError: If the certificate is damaged.
    """
    path, labels = scene.root / CERTIFICATE, [scene.periods[period].label for period in periods]
    if not path.is_file():
        return None
    data = read_json_document(path)
    try:
        numbers = {item["label"]: item["period"] for item in data["periods"]}
        wanted = sorted(numbers.get(label, -1) for label in labels)
        figures = {
            figure["name"]: figure["interval"]
            for pair in data["pairs"]
            for figure in pair["figures"]
            if sorted(pair["periods"]) == wanted and figure["unit"] == "m"
        }
        limits = [float(figures[name][1]) for name in _DISPLACEMENTS if figures.get(name)]
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise SceneError(
            path,
            expected="a certificate of chronoscene register",
            found=f"other JSON ({type(error).__name__}: {error})",
            todo="copy the certificate again, or remove it",
        ) from error
    if not limits:
        return None
    return Registration(limits[-1] / CONFIDENCE, f"{CERTIFICATE}, displacement of the pair")
