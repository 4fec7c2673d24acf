"""Difference of the elevations of two periods, its level of detection, and volumes over polygons.

With s the spreads of the heights of both periods, r the uncertainty of their alignment, and c the
factor of `StableGround`:

    level of detection = 1.96 sqrt(c^2 (s1^2 + s2^2) + r^2).

A model shares errors between its periods. These cancel where nothing changed, so c is less than 1.

A volume is the sum of the differences of n cells, times the area A of a cell. Its standard
deviation is ``n A sqrt(v g + r^2)``, where v is the mean variance of the cells, and g the variance
of their mean by `variance_of_mean`: what neighbours share shrinks slowly, an error of the alignment
not at all. The variance of a cell is c^2 (s1^2 + s2^2), without c where it changed significantly,
as errors do not cancel there.

Sources: Brasington, Langham and Rumsby 2003; Lane, Westaway and Hicks 2003; Wheaton et al. 2010.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.scene import Scene
from chronoscene.survey.grid import Grid
from chronoscene.survey.surface import Surface
from chronoscene.survey.uncertainty import (
    CONFIDENCE,
    Registration,
    StableGround,
    find_registration,
    stable_ground,
    variance_of_mean,
)


@dataclass(frozen=True, slots=True, eq=False)
class Difference:
    """Elevations of the second period minus those of the first."""

    periods: tuple[int, int]
    values: Array
    """Metres; NaN where one of them is unknown. [H, W]"""
    variance: Array
    """Sum of the squared spreads of both. [H, W]"""
    stable: StableGround
    registration: Registration

    @property
    def level(self) -> Array:
        """Level of detection at 95 %. [H, W]"""
        own = self.stable.factor**2 * self.variance
        return np.asarray(CONFIDENCE * np.sqrt(own + self.registration.sigma**2))

    @property
    def significant(self) -> Mask:
        """Cells whose difference exceeds its level of detection. [H, W]"""
        with np.errstate(invalid="ignore"):
            return np.asarray(np.abs(self.values) > self.level)


@dataclass(frozen=True, slots=True)
class Volumes:
    """Volumes in cubic metres of a polygon, each with half of its 95 % interval.

    They are None if the periods have no known cell of it in common.
    """

    polygon: str
    area_m2: float
    """Area of the cells that both periods know."""
    known_share: float
    """Share that this is of the polygon, of which a part may lie off the map."""
    fill_m3: float | None
    """Volume of the cells that have risen significantly."""
    fill_interval_m3: float | None
    cut_m3: float | None
    """Volume of the cells that have sunk significantly, positive."""
    cut_interval_m3: float | None
    net_m3: float | None
    """Balance of all cells: leaving out small differences would distort it."""
    net_interval_m3: float | None


def subtract(
    scene: Scene, grid: Grid, surfaces: Mapping[int, Surface], periods: tuple[int, int]
) -> Difference:
    """Subtract the heights of the first period from those of the second.

    Raises:
        SceneError: If the certificate of the scene is damaged.
    """
    first, second = (surfaces[period] for period in periods)
    values = second.heights - first.heights
    variance = first.spread**2 + second.spread**2
    stable = stable_ground(values, np.sqrt(variance), grid.resolution)
    area = stable.cells * grid.resolution**2
    registration = find_registration(scene, periods, stable, area)
    return Difference(periods, values, variance, stable, registration)


def measure_volumes(
    difference: Difference, grid: Grid, polygon: str, inside: Mask, on_map: float = 1.0
) -> Volumes:
    """Measure the volumes of a polygon.

    Args:
        difference: Between two periods.
        grid: Its cells.
        polygon: Name of the polygon.
        inside: Its cells. [H, W]
        on_map: Share of the polygon that is on the map.
    """
    known = inside & np.isfinite(difference.values)
    if not known.any():
        return Volumes(polygon, 0.0, 0.0, *(None,) * 6)
    changed, rises = known & difference.significant, difference.values > 0
    fill, cut, net = (
        _volume(difference, grid.resolution**2, cells)
        for cells in (changed & rises, changed & ~rises, known)
    )
    area = float(known.sum() * grid.resolution**2)
    share = on_map * float(known.sum() / inside.sum())
    return Volumes(polygon, area, share, *fill, abs(cut[0]), cut[1], *net)


def _volume(difference: Difference, cell: float, cells: Mask) -> tuple[float, float]:
    """Volume of some cells, each of an area ``cell``, and half of its interval."""
    count = int(cells.sum())
    if not count:
        return 0.0, 0.0
    shared = variance_of_mean(count * cell, difference.stable.length, count)
    factor = difference.stable.factor
    factors = np.where(difference.significant[cells], max(1.0, factor), factor)
    variance = float((factors**2 * difference.variance[cells]).mean()) * shared
    deviation = count * cell * np.sqrt(variance + difference.registration.sigma**2)
    return float(difference.values[cells].sum()) * cell, float(CONFIDENCE * deviation)
