"""Held-out observations that disagree: scattered, as single false ties are, or together.

False matches each err in a way of their own, and robust estimation ignores them. What disagrees in
one direction is another opinion about the alignment: one of the two is a repetition of the scene.
What disagrees in a few images shows that their poses are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.registration.quality.misalignment import Transfers
from chronoscene.registration.quality.rays import PlacedPoints

MIN_DISAGREEING = 4  # Tracks; fewer move together by chance
MAX_DISAGREEING = 400  # Tracks that are compared with each other

SAME_STEP = 11.3  # Chi-square of three coordinates, 99 %

MIN_OF_IMAGE = 8  # Observations by which an image is judged
GATHERED = 4.0  # Deviations above the usual share of an image


@dataclass(frozen=True, slots=True)
class Disagreement:
    """Shares between 0, scattered, and 1, together."""

    step: float = 0.0
    """Part of the disagreeing tracks that one step in space explains."""
    images: float = 0.0
    """Part of the disagreeing observations in images where they gather."""


def disagreement(
    moved: Transfers, disagrees: Mask, placed: tuple[PlacedPoints, PlacedPoints], noise: float
) -> Disagreement:
    """Measure if disagreeing observations are scattered.

    Args:
        moved: Observations between two periods.
        disagrees: Those that do not fit. [O]
        placed: Points by either of the periods.
        noise: Deviation of an observation, pixels.
    """
    a, b = placed
    found, slot = b.find(a.track)
    tracks = np.unique(moved.rays.track[disagrees])
    rows = np.flatnonzero(np.isin(a.track[found], tracks))[:MAX_DISAGREEING]
    here, there = a.select(np.flatnonzero(found)[rows]), b.select(slot[rows])
    gaps, spread = there.xyz - here.xyz, noise**2 * (there.covariance + here.covariance)
    return Disagreement(_step(gaps, spread), _images(moved.rays.image, disagrees))


def _step(gaps: Array, spread: Array) -> float:
    """Largest share of gaps that are equal but for their spread. [K, 3], [K, 3, 3]"""
    if len(gaps) < MIN_DISAGREEING:
        return 0.0
    apart = gaps[:, None] - gaps
    square = np.linalg.solve(spread[:, None] + spread, apart[..., None])[..., 0]
    same = (apart * square).sum(axis=2) < SAME_STEP
    return float((same.sum(axis=1).max() - 1) / (len(gaps) - 1))


def _images(image: Ints, disagrees: Mask) -> float:
    """Share of the disagreeing observations in images with many more than usual. [O], [O]"""
    total, bad = np.bincount(image), np.bincount(image[disagrees], minlength=image.max() + 1)
    usual = disagrees.mean()
    deviation = np.sqrt(np.maximum(total * usual * (1 - usual), 1e-12))
    gathered = (total >= MIN_OF_IMAGE) & (bad - total * usual > GATHERED * deviation)
    return float(bad[gathered].sum() / max(bad.sum(), 1))
