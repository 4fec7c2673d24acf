"""Distance between the surfaces that two periods see, apart from any match between them.

Every point is placed by the images of one period alone. Around core points of one cloud, both
clouds are averaged along the local normal; what is left is compared with the level of detection,
``1.96 sqrt(s1^2 / n1 + s2^2 / n2) + registration error``.

Source: Lague, Brodu and Leroux 2013 (M3C2). Ours takes a fixed number of neighbours within a radius
instead of a cylinder, because sparse clouds differ widely in density.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.registration.quality.misalignment import Interval
from chronoscene.registration.quality.rays import Array, Mask, Placed
from chronoscene.scene.similarity import SIGMA

NEIGHBOURS = 16
"""Points that make up a patch of a cloud."""

FEWEST_NEAR = 5
"""Points of the other cloud that a core point needs."""

MOST_CORES = 4000

FEWEST_CORES = 30
"""Stable core points below which nothing is concluded."""

LARGEST_ROUGHNESS = 0.25
"""Of a patch, against its radius: what is rougher is a bush, not a surface."""

CONFIDENCE = 1.96

TRIALS = 300
"""Triples of core points that are tried as a common shift."""

NOTABLY = 1.1
"""Times as many core points as no shift must a shift explain."""


@dataclass(frozen=True, slots=True)
class CloudDistance:
    """Point-to-plane distances on stable structure, in world units."""

    cores: int
    """Core points where both periods have a surface."""
    stable: int
    """Those that one common shift explains: where nothing changed, that is all of them."""
    median: float
    """Of the absolute distance over stable core points."""
    level: float
    """Median level of detection: less than this is not a difference."""
    beyond: float
    """Share of the stable core points beyond their level of detection."""
    shift: Interval
    """Translation that would bring the clouds together, with its 95% interval."""


def cloud_distance(
    first: Placed, second: Placed, centre: Array, registration: float
) -> CloudDistance | str:
    """Compare the clouds of two periods, or say why that is not possible.

    Args:
        first: Points placed by the images of one period.
        second: Points placed by the images of the other.
        centre: Some camera centre: normals are turned to it. [3]
        registration: Standard deviation of the alignment, in world units.
    """
    from scipy.spatial import cKDTree

    if min(len(first.xyz), len(second.xyz)) < NEIGHBOURS:
        return f"{len(first.xyz)} and {len(second.xyz)} points: too few for surfaces"
    trees = cKDTree(first.xyz), cKDTree(second.xyz)
    step = len(second.xyz) // MOST_CORES + 1
    cores = second.xyz[::step]
    near, patch = trees[0].query(cores, NEIGHBOURS)
    radius = near[:, -1]
    own, mine = trees[1].query(cores, NEIGHBOURS)
    mean, normal, spread = _planes(first.xyz[patch])
    normal *= np.where(((centre - mean) * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    inside = own <= radius[:, None]
    # Core points off the edge of the first surface have all their neighbours on one side.
    across = mean - cores - ((mean - cores) * normal).sum(axis=1, keepdims=True) * normal
    usable = spread < LARGEST_ROUGHNESS * radius
    usable &= np.linalg.norm(across, axis=1) < 0.5 * radius
    usable &= inside.sum(axis=1) >= FEWEST_NEAR
    usable &= radius < _largest_radius(first.xyz, trees[0])
    if usable.sum() < FEWEST_CORES:
        return f"surfaces of both periods meet at {int(usable.sum())} core points only"
    along = ((second.xyz[mine] - mean[:, None]) * normal[:, None]).sum(axis=2)
    distance, other, count = _mean_within(along[usable], inside[usable])
    chance = np.sqrt(spread[usable] ** 2 / NEIGHBOURS + other**2 / count)
    return _summary(distance, normal[usable], chance, registration)


def _planes(patches: Array) -> tuple[Array, Array, Array]:
    """Mean, unit normal and deviation along it of patches. [K, n, 3]"""
    mean = patches.mean(axis=1)
    away = patches - mean[:, None]
    values, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", away, away) / patches.shape[1])
    return mean, vectors[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0.0))


def _largest_radius(points: Array, tree: object) -> float:
    """Patches much wider than the usual one lie where the cloud has holes."""
    some = points[:: len(points) // 1000 + 1]
    near = tree.query(some, NEIGHBOURS)[0][:, -1]  # type: ignore[attr-defined]
    return 3.0 * float(np.median(near))


def _mean_within(along: Array, inside: Mask) -> tuple[Array, Array, Array]:
    """Mean, standard deviation and number of the entries inside. [K, n] -> [K] each"""
    count = inside.sum(axis=1)
    mean = np.where(inside, along, 0.0).sum(axis=1) / count
    square = np.where(inside, (along - mean[:, None]) ** 2, 0.0).sum(axis=1)
    return mean, np.sqrt(square / (count - 1)), count.astype(np.float64)


def _summary(
    distance: Array, normal: Array, chance: Array, registration: float
) -> CloudDistance | str:
    stable = _stable(distance, normal, chance)
    if stable.sum() < FEWEST_CORES:
        return f"{int(stable.sum())} core points on structure that did not change"
    level = CONFIDENCE * chance + registration
    size = np.abs(distance[stable])
    return CloudDistance(
        cores=len(distance),
        stable=int(stable.sum()),
        median=float(np.median(size)),
        level=float(np.median(level[stable])),
        beyond=float(np.mean(size > level[stable])),
        shift=_shift(distance[stable], normal[stable], chance[stable]),
    )


def _stable(distance: Array, normal: Array, chance: Array) -> Mask:
    """Core points that did not change: the largest set that one translation explains.

    Zero is preferred unless another translation explains notably more: three core points fix a
    translation, and the best of many triples is taken.
    """
    rng = np.random.default_rng(0)
    reach = 3 * np.maximum(chance, float(np.median(chance)))
    triples = rng.integers(0, len(distance), (TRIALS, 3))
    sides = normal[triples]
    good = np.abs(np.linalg.det(sides)) > 0.1
    moves = np.linalg.solve(sides[good], distance[triples[good]][:, :, None])[:, :, 0]
    best = np.abs(distance) <= reach
    least = NOTABLY * best.sum()
    for move in moves:
        agree = np.abs(distance - normal @ move) <= reach
        if agree.sum() > least:
            best, least = agree, float(agree.sum())
    return np.asarray(best)


def _shift(distance: Array, normal: Array, chance: Array) -> Interval:
    """Translation t with ``n . t = distance``: one step of point-to-plane ICP, reweighted.

    A direction that no surface faces (along a street, say) gets a wide interval.
    """
    weight = 1.0 / np.maximum(chance, np.median(chance) * 0.1) ** 2
    prior = 1e-6 * weight.sum() * np.eye(3)
    robust = np.ones(len(distance))
    for _ in range(5):
        w = weight * robust
        left = np.einsum("ni,n,nj->ij", normal, w, normal) + prior
        t = np.linalg.solve(left, normal.T @ (w * distance))
        residual = (distance - normal @ t) * np.sqrt(weight)
        scale = max(float(SIGMA * np.median(np.abs(residual))), 1e-12)
        robust = 1.0 / (1.0 + (residual / (2 * scale)) ** 2)
    # Neighbouring patches share points: about NEIGHBOURS core points make one independent one.
    covariance = np.linalg.inv(left) * scale**2 * NEIGHBOURS
    spread = CONFIDENCE * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    value = float(np.linalg.norm(t))
    return Interval(value, max(0.0, value - spread), value + spread)
