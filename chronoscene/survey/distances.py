"""Signed distances between two point clouds along their normals, by M3C2 of py4dgeo.

Normals are turned to the cameras, so that a positive distance means that something was added. The
unit of all lengths is the spacing of the points, or twice their spread if that is more. Normals are
those of a patch of radius 5: 20 times the spread in diameter, as the source advises. A cylinder has
half of that radius, and so 20 points of an even surface; its median counts, as some points float.

M3C2 takes points as independent. Those of a model are not, so its level of detection is multiplied
by the `excess` of the distances over it, as long as that is more than 1.

Source: Lague, Brodu and Leroux 2013.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array
from chronoscene.survey.cloud import PointCloud
from chronoscene.survey.uncertainty import CONFIDENCE, excess

MIN_POINTS = 1000  # Of a cloud
CYLINDER, PATCH, DEPTH, CORES = 2.5, 5.0, 20.0, 4.0
"""Radius of cylinders and of patches, half length of cylinders, distance of core points."""


@dataclass(frozen=True, slots=True, eq=False)
class Distances:
    """M3C2 at the core points of the first cloud where the second has a surface."""

    cores: PointCloud
    """[N]"""
    values: Array
    """Metres. [N]"""
    level: Array
    """Level of detection at 95 %. [N]"""
    slope: Array
    """Degrees between the surface and the horizontal. [N]"""


def measure_distances(
    first: PointCloud, second: PointCloud, spacing: float, registration: float
) -> Distances | str:
    """Measure the distances from the first cloud to the second; the reason, if that is impossible.

    Args:
        first: Cloud of the earlier period.
        second: Cloud of the later period.
        spacing: Of the points, metres.
        registration: Standard deviation of the alignment, metres.
    """
    if min(len(first), len(second)) < MIN_POINTS:
        return f"{len(first)} and {len(second)} points are too few for surfaces"
    import py4dgeo

    log = logging.getLogger("py4dgeo")
    log.setLevel(logging.WARNING)
    log.handlers.clear()  # one of them writes a file into the current folder
    spread = float(np.nan_to_num(np.median(np.concatenate([first.spread, second.spread]))))
    unit = max(spacing, 2 * spread)
    first, second = first.thinned(unit), second.thinned(unit)
    cores, origin = first.thinned(CORES * unit), first.xyz.mean(axis=0)
    method = py4dgeo.M3C2(
        epochs=tuple(py4dgeo.Epoch(c.xyz - origin) for c in (first, second)),
        corepoints=cores.xyz - origin,
        normal_radii=[PATCH * unit],
        cyl_radius=CYLINDER * unit,
        max_distance=DEPTH * unit,
        registration_error=registration,
        robust_aggr=True,
    )
    normals = np.array(method.directions())
    away = (normals * cores.to_camera).sum(axis=1, keepdims=True) < 0
    method.corepoint_normals = np.where(away, -normals, normals)
    values, uncertainty = method.run()
    level = uncertainty["lodetection"]
    known = np.isfinite(values) & np.isfinite(level)
    if known.any():
        level = level * max(1.0, excess(values[known], level[known] / CONFIDENCE))
    slope = np.degrees(np.arccos(np.clip(np.abs(normals[:, 2]), 0, 1)))
    return Distances(cores.select(known), values[known], level[known], slope[known])
