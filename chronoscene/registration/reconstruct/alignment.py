"""Robust similarities between models that share no image, from matches between their points.

Residuals are measured in pixels, in both images of a match, because a threshold in world units
means nothing in a model of unknown scale and treats near and far points alike.

The consensus counts places instead of matches. A heap of sand that grew, or a row of parked cars,
can have more matches than the buildings around it. Points are therefore assigned to cells of space,
and each cell has the same weight in drawing samples and in judging them: a change fills few cells,
however much texture it has.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.scene.similarity import Sim3, Similarity, fit, fit_samples

TRIALS = 1_000
MAX_JUDGED = 4_000  # Matches by which a trial is judged

SEARCH_PIXELS = 16.0
"""Residual of an inlier while searching: points of two models of their own are this uncertain."""

FINAL_PIXELS = 8.0  # Residual of an inlier in the end

MIN_INLIERS = 15  # Fewer do not fix a similarity that can be trusted
MIN_CELLS = 4  # Neither do many in fewer places than these
MAX_SCALE = 50.0
"""Models of a mapper have about one size. One that fits another at a much smaller or larger scale
has shrunk to a point of it."""

CELLS_PER_AXIS = 12  # Along each of the two directions in which the points spread most
QUANTILE = 0.02  # Points outside of this quantile and its mirror image do not stretch the grid


@dataclass(frozen=True, slots=True, eq=False)
class PointPairs:
    """The same places in two models: M pairs, each with the observation that joined them."""

    source: Array
    """Points of the model that is to be moved. [M, 3]"""
    target: Array
    """[M, 3]"""
    source_pose: Array
    """``cam_from_world`` of the image that sees the source point, in its own model. [M, 4, 4]"""
    target_pose: Array
    """[M, 4, 4]"""
    source_ray: Array
    """Observation of the source point, at depth 1 without distortion. [M, 2]"""
    target_ray: Array
    source_focal: Array
    """Pixels. [M]"""
    target_focal: Array

    def __len__(self) -> int:
        return len(self.source)

    def select(self, rows: Ints | Mask) -> PointPairs:
        return PointPairs(*(getattr(self, name)[rows] for name in self.__slots__))


@dataclass(frozen=True, slots=True, eq=False)
class Alignment:
    """Alignment of one model to another."""

    target_from_source: Sim3
    inliers: Mask
    """[M]"""
    cells: int
    """Places in which there are inliers."""
    median_pixels: float
    """Median residual of the inliers."""

    @property
    def is_trustworthy(self) -> bool:
        """True if enough pairs in enough places agree, at a scale that is not absurd."""
        scale = self.target_from_source.scale
        sane = 1 / MAX_SCALE < scale < MAX_SCALE
        return int(self.inliers.sum()) >= MIN_INLIERS and self.cells >= MIN_CELLS and sane


def align_by_points(pairs: PointPairs) -> Alignment | None:
    """Similarity on which most places agree; None if there is nothing to agree on."""
    if len(pairs) < 3:
        return None
    rng = np.random.default_rng(0)
    cell = cells(pairs.target)
    members, weights = cell_members(cell), cell_weights(cell)
    judges = np.arange(len(pairs))
    if len(judges) > MAX_JUDGED:
        judges = rng.choice(len(judges), MAX_JUDGED, replace=False)
    judged = pairs.select(judges)
    samples = [
        draw(rng, members, 3) if len(members) >= 3 else rng.choice(len(pairs), 3, False)
        for _ in range(TRIALS)
    ]

    def disagreements(candidates: Similarity) -> Array:
        sims = [candidates[i].to_sim3() for i in range(len(candidates))]
        near = [residual_pixels(sim, judged) < SEARCH_PIXELS for sim in sims]
        return np.array([-weights[judges][mask].sum() for mask in near])

    best, _ = fit_samples(pairs.source, pairs.target, np.array(samples), disagreements)
    return None if best is None else _polish(pairs, best.to_sim3(), cell)


def _polish(pairs: PointPairs, best: Sim3, cell: Ints) -> Alignment | None:
    """Least squares over the inliers, with a threshold that shrinks."""
    inliers = residual_pixels(best, pairs) < SEARCH_PIXELS
    for limit in (SEARCH_PIXELS, SEARCH_PIXELS, FINAL_PIXELS, FINAL_PIXELS):
        if inliers.sum() < 3:
            return None
        better = fit_sim3(pairs.source[inliers], pairs.target[inliers])
        if better is None:
            return None
        now = residual_pixels(better, pairs) < limit
        if limit == SEARCH_PIXELS and now.sum() < inliers.sum():
            now = residual_pixels(best, pairs) < limit  # far points pull at a 3D fit
        else:
            best = better
        inliers = now
    residual = residual_pixels(best, pairs)
    median = float(np.median(residual[inliers])) if inliers.any() else np.inf
    count = len(np.unique(cell[inliers]))
    return Alignment(best, inliers, cells=count, median_pixels=median)


def residual_pixels(target_from_source: Sim3, pairs: PointPairs) -> Array:
    """Larger of the two reprojection errors of each pair: each point in the other's image. [M]"""
    in_target = target_from_source.apply(pairs.source)
    in_source = target_from_source.inverse().apply(pairs.target)
    a = _reprojection(pairs.target_pose, in_target, pairs.target_ray) * pairs.target_focal
    b = _reprojection(pairs.source_pose, in_source, pairs.source_ray) * pairs.source_focal
    return np.maximum(a, b)


def _reprojection(poses: Array, points: Array, rays: Array) -> Array:
    """Distance at depth 1; infinite behind the camera. [M]"""
    local = np.einsum("nij,nj->ni", poses[:, :3, :3], points) + poses[:, :3, 3]
    depth = local[:, 2]
    ahead = depth > 1e-12
    projected = local[:, :2] / np.where(ahead, depth, 1.0)[:, None]
    return np.where(ahead, np.linalg.norm(projected - rays, axis=1), np.inf)


def fit_sim3(source: Array, target: Array) -> Sim3 | None:
    """Least-squares similarity of points; None where they do not determine one. [N, 3]"""
    found = fit(source, target)
    return None if found is None else found.to_sim3()


def cells(points: Array) -> Ints:
    """Cell of each point, numbered without gaps. [N, 3] -> [N]

    The grid lies in the plane of the two principal directions: scenes are wide and flat.
    """
    if not len(points):
        return np.zeros(0, np.int64)
    low, high = np.quantile(points, [QUANTILE, 1 - QUANTILE], axis=0)
    inside = np.clip(points, low, high)
    centred = inside - inside.mean(axis=0)
    _, _, axes = np.linalg.svd(centred, full_matrices=False)
    flat = centred @ axes[:2].T
    extent = max(float(np.ptp(flat, axis=0).max()), 1e-12)
    index = np.floor((flat - flat.min(axis=0)) / extent * CELLS_PER_AXIS).astype(np.int64)
    index = np.minimum(index, CELLS_PER_AXIS - 1)
    _, cell = np.unique(index, axis=0, return_inverse=True)
    return np.asarray(cell.ravel(), np.int64)


def cell_weights(cell: Ints) -> Array:
    """Weight of each point such that a cell counts as the root of its number of points. [N]

    Between one vote for each point and one for each cell: an almost empty cell may be an accident.
    """
    counts = np.bincount(cell) if len(cell) else np.ones(1)
    return 1.0 / np.sqrt(counts[cell])


def draw(rng: np.random.Generator, members: list[Ints], count: int) -> Ints:
    """Points of as many different cells. [count]"""
    chosen = rng.choice(len(members), count, replace=False)
    return np.array([members[c][rng.integers(len(members[c]))] for c in chosen])


def cell_members(cell: Ints) -> list[Ints]:
    """Points of each cell."""
    order = np.argsort(cell, kind="stable")
    edges = np.flatnonzero(np.diff(cell[order])) + 1
    return np.split(order, edges) if len(order) else []
