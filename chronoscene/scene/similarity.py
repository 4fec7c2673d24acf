"""Similarity transforms, Sim(3), and fits of them to corresponding points."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations, islice

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.arrays import Array, Ints
from chronoscene.scene.geometry import pose_from_rotation_translation

NUM_SAMPLES = 200
"""Triples of points that are tried. With half of the points wrong, the chance that all
of them have a wrong one is 3 x 10^-12."""

MAX_JUDGED = 1000  # Points that a triple is evaluated on
MAX_TRIPLES = 5000  # Triples that are tried where points are few
AT_ONCE = 50  # Triples that are fitted and judged in one go: more do not stay in the cache

MIN_THICKNESS = 0.02
"""Spread across a line as a share of that along it, below which points fix no rotation."""

SIGMA = 1.4826
"""Standard deviation of normal numbers in units of the median of their absolute values."""


def median_and_nmad(values: Array) -> tuple[float, float]:
    """Compute the median, and the robust standard deviation: `SIGMA` times that of the deviations.

    Source: Hoehle and Hoehle 2009.
    """
    median = float(np.median(values))
    return median, SIGMA * float(np.median(np.abs(values - median)))


@dataclass(frozen=True, slots=True)
class Sim3:
    """Similarity ``x -> scale * rotation @ x + translation``, named ``target_from_source``."""

    scale: float
    rotation: Array
    translation: Array

    @classmethod
    def identity(cls) -> Sim3:
        return cls(1.0, np.eye(3), np.zeros(3))

    def apply(self, points: ArrayLike) -> Array:
        """Transform points. [..., 3]"""
        points = np.asarray(points, dtype=np.float64)
        return self.scale * points @ self.rotation.T + self.translation

    def __matmul__(self, first: Sim3) -> Sim3:
        """Apply ``first``, then this: ``c_from_b @ b_from_a`` is ``c_from_a``."""
        return Sim3(
            self.scale * first.scale,
            self.rotation @ first.rotation,
            self.scale * self.rotation @ first.translation + self.translation,
        )

    def apply_to_pose(self, cam_from_source: Array) -> Array:
        """Express a camera pose in the target frame; depths grow by ``scale``. [..., 4, 4]"""
        pose = np.array(cam_from_source, dtype=np.float64)
        rotation = pose[..., :3, :3] @ self.rotation.T
        pose[..., :3, 3] = self.scale * pose[..., :3, 3] - rotation @ self.translation
        pose[..., :3, :3] = rotation
        return pose

    def inverse(self) -> Sim3:
        return Sim3(
            1.0 / self.scale, self.rotation.T, -self.rotation.T @ self.translation / self.scale
        )

    def to_matrix(self) -> Array:
        """Return the 4x4 matrix [[scale * rotation, translation], [0, 1]]."""
        return pose_from_rotation_translation(self.scale * self.rotation, self.translation)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Sim3:
        """Invert `to_matrix`: the ``training_from_world`` of a checkpoint, for example."""
        m = np.asarray(matrix, dtype=np.float64)
        scale = float(np.cbrt(np.linalg.det(m[:3, :3])))
        return cls(scale, m[:3, :3] / scale, m[:3, 3].copy())


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x -> matrix @ x + translation``: the result of a fit, or of many (S fits)."""

    matrix: Array
    """Scale times a rotation. [3, 3] or [S, 3, 3]"""
    translation: Array
    """[3] or [S, 3]"""

    def __len__(self) -> int:
        return len(self.translation)

    def __getitem__(self, number: int) -> Similarity:
        """Take one of many."""
        return Similarity(self.matrix[number], self.translation[number])

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.matrix)))

    def apply(self, points: Array) -> Array:
        """Transform points, by each of many. [N, 3] -> [N, 3] or [S, N, 3]"""
        moved = points @ np.swapaxes(self.matrix, -1, -2)
        return np.asarray(moved + self.translation[..., None, :])

    def to_sim3(self) -> Sim3:
        """Convert to a `Sim3`."""
        scale = self.scale
        return Sim3(scale, self.matrix / scale, self.translation)


def fit(source: Array, target: Array) -> Similarity | None:
    """Fit a similarity to corresponding points by least squares; None if they determine none.

    Args:
        source: At least three points, not on one line. [N, 3]
        target: Their targets. [N, 3]
    """
    found = _fit_each(source[None], target[None])
    return found[0] if len(found) else None


def _fit_each(source: Array, target: Array) -> Similarity:
    """Fit as `fit` does to each of many sets; those that determine none are left out. [S, N, 3]

    Source: Umeyama 1991, equations 40 to 42.
    """
    centre_source, centre_target = source.mean(axis=1), target.mean(axis=1)
    a, b = source - centre_source[:, None], target - centre_target[:, None]
    variance = (a * a).sum(axis=(1, 2))
    covariance = np.swapaxes(b, 1, 2) @ a
    usable = (variance > 0) & np.isfinite(covariance).all(axis=(1, 2))
    u, d, vt = np.linalg.svd(covariance[usable])
    signs = np.ones_like(d)
    signs[np.linalg.det(u) * np.linalg.det(vt) < 0, 2] = -1
    scale = (d * signs).sum(axis=1) / variance[usable]
    matrix = scale[:, None, None] * (u * signs[:, None]) @ vt
    translation = centre_target[usable] - (matrix @ centre_source[usable, :, None])[..., 0]
    determined = d[:, 1] > 1e-9 * d[:, 0]
    return Similarity(matrix[determined], translation[determined])


def fit_samples(
    source: Array, target: Array, samples: Ints, cost: Callable[[Similarity], Array]
) -> tuple[Similarity | None, float]:
    """Fit a similarity to each sample; return the first one of least cost, and its cost.

    Args:
        source: [N, 3]
        target: [N, 3]
        samples: Rows of the points of each. [S, 3]
        cost: Computes the cost of each of many similarities.
    """
    best, least = None, np.inf
    for start in range(0, len(samples), AT_ONCE):
        rows = samples[start : start + AT_ONCE]
        candidates = _fit_each(source[rows], target[rows])
        costs = cost(candidates)
        costs = np.where(np.isnan(costs), np.inf, costs)
        if costs.min(initial=np.inf) < least:
            number = int(costs.argmin())
            best, least = candidates[number], float(costs[number])
    return best, least


def fit_robustly(source: Array, target: Array, *, axes: int = 3) -> tuple[Similarity, Array] | None:
    """Fit a similarity that most points agree on; return it and the distances to the targets.

    The best of many triples by median distance, then least squares over the points within 2.5
    standard deviations. Deterministic.

    Args:
        source: [N, 3]
        target: [N, 3]
        axes: Number of target axes along which distances are measured: 2 ignores heights.

    Source: least median of squares, Rousseeuw 1984.
    """
    rng = np.random.default_rng(0)
    judges = rng.permutation(len(source))[:MAX_JUDGED]
    triples = [rng.choice(len(source), 3, replace=False) for _ in range(NUM_SAMPLES)]

    def medians(candidates: Similarity) -> Array:
        distances = _distances(candidates, source[judges], target[judges], axes)
        return np.asarray(np.median(distances, axis=1))

    best, _ = fit_samples(source, target, np.array(triples), medians)
    for _ in range(3):
        if best is None:
            return None
        distance = _distances(best, source, target, axes)
        near = distance <= 2.5 * SIGMA * np.median(distance)
        best = fit(source[near], target[near]) or best
    return (best, _distances(best, source, target, axes)) if best is not None else None


def _distances(similarity: Similarity, source: Array, target: Array, axes: int) -> Array:
    return np.asarray(np.linalg.norm((similarity.apply(source) - target)[..., :axes], axis=-1))


def fit_few(source: Array, target: Array) -> tuple[Sim3, NDArray[np.bool_]] | None:
    """Fit a similarity to a few points; return it and the points used, None if undetermined.

    With six points or more, wrong ones are left out: of the similarities of all triples the one
    with the smallest median distance is taken, then all points within three deviations of it.

    Args:
        source: [N, 3]
        target: [N, 3]
    """
    count = len(source)
    if count < 3 or _thickness(source) < MIN_THICKNESS or _thickness(target) < MIN_THICKNESS:
        return None
    used = np.ones(count, bool)
    if count >= 6:  # of five, two beside the triple could agree by chance
        triples = np.array([*islice(combinations(range(count), 3), MAX_TRIPLES)])
        wide = triples[_thickness(source[triples]) >= MIN_THICKNESS]

        def middles(trials: Similarity) -> Array:  # the points of a triple fit by construction
            distances = _distances(trials, source, target, 3)
            return np.asarray(np.sort(distances, axis=1)[:, (count + 3) // 2])

        best, smallest = fit_samples(source, target, wide, middles)
        if best is not None:
            distance = _distances(best, source, target, 3)
            spread = 3 * SIGMA * max(smallest, 1e-4 * float(np.ptp(target, axis=0).max()))
            if (distance <= spread).sum() >= 3:
                used = distance <= spread
    whole = fit(source[used], target[used])
    return None if whole is None else (whole.to_sim3(), np.asarray(used))


def scale_deviation(residuals: Array, target: Array) -> float:
    """Relative standard deviation of the scale of a similarity that was fitted to points.

    Args:
        residuals: After the fit; the standard deviation of one coordinate is estimated from
            them. [N, 2] in a plane, or [N, 3]
        target: The points, whose spread is what determines the scale. The same shape.
    """
    unknowns = 4 if target.shape[1] == 2 else 7
    deviation = np.sqrt((residuals**2).sum() / max(target.size - unknowns, 1))
    spread = np.linalg.norm(target - target.mean(axis=0))
    return float(deviation / max(spread, 1e-9))


def _thickness(points: Array) -> Array:
    """Divide the second singular value by the first: 0 on a line. [..., N, 3] -> [...]"""
    centred = points - points.mean(axis=-2, keepdims=True)
    values = np.linalg.svd(centred, compute_uv=False)
    return np.asarray(values[..., 1] / np.maximum(values[..., 0], np.finfo(float).tiny))
