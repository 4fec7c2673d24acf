"""Where anchors start: one per occupied voxel of the sparse cloud of all periods.

Source: Scaffold-GS (Lu et al., CVPR 2024) and the official ChronoGS code. Differences are named
options of `AnchorConfig`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.training.sparse_points import rms_spacing

MIN_DISTANCE = 1e-7
"""Lower bound of a neighbour distance: keeps the log-scales of coinciding points finite."""


def cell_indices(
    positions: NDArray[np.floating], size: float, origin: NDArray[np.float64] | None = None
) -> NDArray[np.int64]:
    """Cell of each position: the nearest multiple of ``size``, halves to even. [P, 3] -> [P, 3]"""
    shifted = positions.astype(np.float64)
    if origin is not None:
        shifted -= origin
    return np.round(shifted / size).astype(np.int64)


def pack_cells(cells: NDArray[np.int64]) -> NDArray[np.int64]:
    """One integer per cell, equal exactly where the cells are equal. [P, 3] -> [P]

    Keys of different calls are not comparable: pack everything that is compared in one call.
    """
    if len(cells) == 0:
        return np.zeros(0, np.int64)
    low = cells.min(axis=0)
    extent = [int(n) for n in cells.max(axis=0) - low + 1]
    if extent[0] * extent[1] * extent[2] < 2**62:
        ranks = cells - low
    else:  # far outliers: ranks per axis are below the number of rows
        ranks = np.stack([np.unique(c, return_inverse=True)[1] for c in cells.T], axis=1)
        extent = [int(n) for n in ranks.max(axis=0) + 1]
    return (ranks[:, 0] * extent[1] + ranks[:, 1]) * extent[2] + ranks[:, 2]


def neighbour_distances(points: NDArray[np.floating]) -> NDArray[np.float64]:
    """Root mean square distance to the three nearest other points, at least `MIN_DISTANCE`. [P]"""
    return np.maximum(rms_spacing(points), MIN_DISTANCE)


def median_spacing(points: NDArray[np.floating]) -> float:
    """Median distance of a point to its nearest other point, in the units of the points."""
    if len(points) < 2:
        return 1.0
    return float(max(np.median(rms_spacing(points, 1)), MIN_DISTANCE))


def resolve_voxel_size(
    points: NDArray[np.floating], value: float, unit: str, *, training_from_world: float
) -> float:
    """Voxel edge in training units.

    Args:
        points: Sparse points in the training frame. [P, 3]
        value: The configured size; 0 means the median over the points of the mean *squared*
            distance to three neighbours, a unit slip that Scaffold-GS and ChronoGS share.
        unit: ``spacing``: multiples of the median neighbour distance; ``training``: units of the
            training frame; ``world``: units of the scene, as in the official code.
        training_from_world: Scale of the similarity from world to training frame.
    """
    if value == 0:
        return float(np.median(np.square(neighbour_distances(points))))
    if unit == "spacing":
        return value * median_spacing(points)
    return value * (training_from_world if unit == "world" else 1.0)


def voxelize(
    points: NDArray[np.floating], size: float, origin: str = "zero"
) -> NDArray[np.float32]:
    """Occupied voxels as positions, sorted by cell. [P, 3] -> [A, 3]

    Args:
        points: [P, 3]
        size: Voxel edge, in the units of the points.
        origin: ``zero``: cells are centred on multiples of ``size`` (official code); ``box``: on
            multiples counted from the lower corner of the bounding box (paper's supplement).
    """
    corner = points.min(axis=0).astype(np.float64) if origin == "box" else np.zeros(3)
    cells = cell_indices(points, size, corner)
    _, first = np.unique(pack_cells(cells), return_index=True)
    return (cells[first] * size + corner).astype(np.float32)


def initial_anchors(
    points: NDArray[np.floating], size: float, *, origin: str = "zero", limit: int = 0
) -> tuple[NDArray[np.float32], float]:
    """Anchors of a cloud, with a coarser voxel where there would be more than ``limit``.

    Returns:
        anchors: [A, 3]
        size: The voxel edge that was used.
    """
    anchors = voxelize(points, size, origin)
    while limit > 0 and len(anchors) > limit:
        size *= 1.1
        anchors = voxelize(points, size, origin)
    return anchors, size


def initial_log_scales(anchors: NDArray[np.floating]) -> NDArray[np.float32]:
    """Log of the neighbour distance, in all six columns. [A, 3] -> [A, 6]"""
    column = np.log(neighbour_distances(anchors)).astype(np.float32)
    return np.repeat(column[:, None], 6, axis=1)
