"""Similarity transforms, Sim(3), and fits of them to corresponding points."""

from __future__ import annotations

from collections.abc import Callable, Iterable
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
    """``x -> matrix @ x + translation``: the result of a fit."""

    matrix: Array
    """Scale times a rotation. [3, 3]"""
    translation: Array

    @property
    def scale(self) -> float:
        return float(np.cbrt(np.linalg.det(self.matrix)))

    def apply(self, points: Array) -> Array:
        """Transform points. [N, 3]"""
        return points @ self.matrix.T + self.translation

    def to_sim3(self) -> Sim3:
        """Convert to a `Sim3`."""
        scale = self.scale
        return Sim3(scale, self.matrix / scale, self.translation)


def fit(source: Array, target: Array) -> Similarity | None:
    """Fit a similarity to corresponding points by least squares; None if they determine none.

    Args:
        source: At least three points, not on one line. [N, 3]
        target: Their targets. [N, 3]

    Source: Umeyama 1991, equations 40 to 42.
    """
    centre_source, centre_target = source.mean(axis=0), target.mean(axis=0)
    a, b = source - centre_source, target - centre_target
    variance = (a * a).sum()
    covariance = b.T @ a
    if not (variance > 0 and np.isfinite(covariance).all()):
        return None
    u, d, vt = np.linalg.svd(covariance)
    if not d[1] > 1e-9 * d[0]:
        return None
    signs = np.ones(3)
    if np.linalg.det(u) * np.linalg.det(vt) < 0:
        signs[2] = -1
    matrix = (d * signs).sum() / variance * (u * signs) @ vt
    return Similarity(matrix, centre_target - matrix @ centre_source)


def fit_samples(
    source: Array, target: Array, samples: Iterable[Ints], cost: Callable[[Similarity], float]
) -> tuple[Similarity | None, float]:
    """Fit a similarity to each sample of rows; the one of least cost, and its cost."""
    best, least = None, np.inf
    for rows in samples:
        candidate = fit(source[rows], target[rows])
        if candidate is not None and (value := cost(candidate)) < least:
            best, least = candidate, value
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
    triples = (rng.choice(len(source), 3, replace=False) for _ in range(NUM_SAMPLES))

    def median(candidate: Similarity) -> float:
        return float(np.median(_distances(candidate, source[judges], target[judges], axes)))

    best, _ = fit_samples(source, target, triples, median)
    for _ in range(3):
        if best is None:
            return None
        distance = _distances(best, source, target, axes)
        near = distance <= 2.5 * SIGMA * np.median(distance)
        best = fit(source[near], target[near]) or best
    return (best, _distances(best, source, target, axes)) if best is not None else None


def _distances(similarity: Similarity, source: Array, target: Array, axes: int) -> Array:
    return np.asarray(np.linalg.norm((similarity.apply(source) - target)[:, :axes], axis=1))


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
        triples = map(np.array, islice(combinations(range(count), 3), MAX_TRIPLES))
        wide = (rows for rows in triples if _thickness(source[rows]) >= MIN_THICKNESS)

        def middle(trial: Similarity) -> float:  # the points of the triple fit by construction
            return float(np.sort(_distances(trial, source, target, 3))[(count + 3) // 2])

        best, smallest = fit_samples(source, target, wide, middle)
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


def _thickness(points: Array) -> float:
    """Divide the second singular value by the first: 0 on a line."""
    values = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return float(values[1] / values[0]) if values[0] > 0 else 0.0
