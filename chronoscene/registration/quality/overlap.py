"""Overlap of two periods: tie points, their distribution, and the images that they tie."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.registration.result import Registered
from chronoscene.scene.tracks import select_tracks

CELLS = 150  # Cells into which the ground plan of the scene is divided
MIN_POINTS_IN_CELL = 3  # Points of each period that make a cell part of the overlap
TIES_OF_IMAGE = 8  # Tie points with which an image counts as tied to the other period


@dataclass(frozen=True, slots=True, eq=False)
class TieSpread:
    """Distribution of the tie points of two periods."""

    points: int
    """Points of the model seen in both periods."""
    cells: int
    """Cells of the ground plan with points of both periods."""
    occupied: float
    """Share of these cells with a tie point."""
    hull: float
    """Area of the convex hull of the tie points against that of the overlap."""
    tied_a: float
    """Share of the images of the first period that see `TIES_OF_IMAGE` tie points or more."""
    tied_b: float
    gaps: Array
    """Centres of overlap cells without a tie point, the fullest first. [G, 3]"""


def tie_spread(
    model: Registered, seen: Mask, a: int, b: int, cells: tuple[Array, Ints]
) -> TieSpread:
    """Count the tie points of two periods, and find where there are none.

    Args:
        model: The registration.
        seen: True if an image of the period sees the point. [P, T]
        a: Earlier period.
        b: Later period.
        cells: From `ground_plan`.
    """
    tie = seen[:, a] & seen[:, b]
    plan, cell = cells
    counts = [np.bincount(cell[mask], minlength=cell.max(initial=0) + 1) for mask in seen.T]
    overlap = (counts[a] >= MIN_POINTS_IN_CELL) & (counts[b] >= MIN_POINTS_IN_CELL)
    tied = np.bincount(cell[tie], minlength=len(overlap)) > 0
    gaps = np.flatnonzero(overlap & ~tied)
    gaps = gaps[np.argsort(-np.minimum(counts[a], counts[b])[gaps], kind="stable")][:20]
    middles = [
        np.median(model.points[(cell == g) & (seen[:, a] | seen[:, b])], axis=0) for g in gaps
    ]
    in_overlap = overlap[cell] & (seen[:, a] | seen[:, b]) if len(cell) else tie
    whole = _hull_area(plan[in_overlap | tie])
    tied_a, tied_b = _tied_images(model, tie, (a, b))
    return TieSpread(
        points=int(tie.sum()),
        cells=int(overlap.sum()),
        occupied=float((overlap & tied).sum() / max(overlap.sum(), 1)),
        hull=_hull_area(plan[tie]) / whole if whole > 0 else 0.0,
        tied_a=tied_a,
        tied_b=tied_b,
        gaps=np.array(middles).reshape(-1, 3),
    )


def ground_plan(points: Array) -> tuple[Array, Ints]:
    """Ground plan of points (their two main axes) and the number of the cell of each."""
    if not len(points):
        return np.zeros((0, 2)), np.zeros(0, np.int64)
    low, high = np.percentile(points, [2, 98], axis=0)
    core = points[((points >= low) & (points <= high)).all(axis=1)]
    core = core if len(core) >= 3 else points
    axes = np.linalg.svd(core - core.mean(axis=0), full_matrices=False)[2][:2]
    plan = (points - core.mean(axis=0)) @ axes.T
    inner = (core - core.mean(axis=0)) @ axes.T
    side = np.sqrt(max(float(np.prod(np.ptp(inner, axis=0))), 1e-30) / CELLS)
    # Points far outside share the outermost cells.
    grid = np.floor((plan - inner.min(axis=0)) / side).clip(-1, 4 * CELLS).astype(np.int64) + 1
    return plan, grid[:, 0] * (4 * CELLS + 2) + grid[:, 1]


def _hull_area(plan: Array) -> float:
    from scipy.spatial import ConvexHull, QhullError

    if len(plan) < 3:
        return 0.0
    try:
        return float(ConvexHull(plan).volume)  # in the plane, "volume" is the area
    except QhullError:  # on a line
        return 0.0


def _tied_images(model: Registered, tie: Mask, periods: tuple[int, int]) -> Iterator[float]:
    """Share of the images of each period that see enough tie points."""
    of_tie = select_tracks(model.track_start, tie)[1]
    count = np.bincount(model.track_image[of_tie], minlength=len(model.names))
    for period in periods:
        mine = count[model.periods == period]
        yield float((mine >= TIES_OF_IMAGE).mean()) if len(mine) else 0.0
