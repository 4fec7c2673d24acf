"""Similarities between two sets of points, also mirrored ones, robust against outliers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

SAMPLES = 200
"""Triples of points that are tried. With half of the points wrong, all of them would be useless
once in 10^11 times."""

MOST_JUDGED = 1000
"""Points by which a triple is judged."""

SIGMA = 1.4826
"""Standard deviation of normal numbers in units of the median of their absolute values."""


@dataclass(frozen=True, slots=True, eq=False)
class Similarity:
    """``x -> matrix @ x + translation``."""

    matrix: Array
    """Scale times a rotation or a reflection. [3, 3]"""
    translation: Array

    @property
    def mirrored(self) -> bool:
        return bool(np.linalg.det(self.matrix) < 0)

    @property
    def scale(self) -> float:
        return float(np.cbrt(abs(np.linalg.det(self.matrix))))

    def apply(self, points: Array) -> Array:
        """Transform points. [N, 3]"""
        return points @ self.matrix.T + self.translation


def fit(source: Array, target: Array, *, mirror: bool = False) -> Similarity | None:
    """Least squares similarity of corresponding points; None where they do not fix one.

    Args:
        source: At least three points, not on one line. [N, 3]
        target: Where they should come to. [N, 3]
        mirror: Whether a reflection is allowed.

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
    if not mirror and np.linalg.det(u) * np.linalg.det(vt) < 0:
        signs[2] = -1
    matrix = (d * signs).sum() / variance * (u * signs) @ vt
    return Similarity(matrix, centre_target - matrix @ centre_source)


def fit_robustly(
    source: Array, target: Array, *, axes: int = 3, mirror: bool = False
) -> tuple[Similarity, Array] | None:
    """Similarity that most of the points agree on, and the distance of every point to its target.

    The best of many triples by the median distance, then least squares over what is within 2.5
    standard deviations of it. The same points always give the same result.

    Args:
        source: [N, 3]
        target: [N, 3]
        axes: Of the target that distances are measured along: 2 leaves heights out.
        mirror: Whether a reflection is allowed.

    Source: least median of squares, Rousseeuw 1984.
    """
    rng = np.random.default_rng(0)
    judges = rng.permutation(len(source))[:MOST_JUDGED]
    best, least = None, np.inf
    for _ in range(SAMPLES):
        triple = rng.choice(len(source), 3, replace=False)
        candidate = fit(source[triple], target[triple], mirror=mirror)
        if candidate is not None:
            median = np.median(_distances(candidate, source[judges], target[judges], axes))
            if median < least:
                best, least = candidate, median
    for _ in range(3):
        if best is None:
            return None
        distance = _distances(best, source, target, axes)
        near = distance <= 2.5 * SIGMA * np.median(distance)
        best = fit(source[near], target[near], mirror=mirror) or best
    return (best, _distances(best, source, target, axes)) if best is not None else None


def _distances(similarity: Similarity, source: Array, target: Array, axes: int) -> Array:
    return np.asarray(np.linalg.norm((similarity.apply(source) - target)[:, :axes], axis=1))
