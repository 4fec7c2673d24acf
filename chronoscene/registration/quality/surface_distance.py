"""Distance between the surfaces that two periods see, without any match between them.

Every point is placed by the images of one period alone. Around core points of one cloud, both
clouds are averaged along the local normal; what is left is compared with the level of detection,
``1.96 sqrt(s1^2 / n1 + s2^2 / n2) + registration error``.

Source: Lague, Brodu and Leroux 2013 (M3C2). Ours takes a fixed number of neighbours within a radius
instead of a cylinder, because sparse clouds differ widely in density.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from chronoscene.arrays import Array, Mask
from chronoscene.registration.quality.misalignment import Interval, Motion, generators
from chronoscene.registration.quality.rays import PlacedPoints
from chronoscene.scene.similarity import SIGMA

NEIGHBOURS = 16  # Points in a patch of a cloud
MIN_NEIGHBOURS = 5  # Points of the other cloud that a core point needs

MAX_CORES = 4000

MIN_CORES = 30  # Fewer stable core points allow no conclusion
MAX_ROUGHNESS = 0.25  # Of a patch, relative to its radius: what is rougher is a bush, not a surface

CONFIDENCE = 1.96

TRIALS = 300  # Triples of core points that are tried as a common shift
NOTABLY = 1.1  # A shift must explain so many times the core points that no shift explains


@dataclass(frozen=True, slots=True)
class SurfaceDistance:
    """Point-to-plane distances on stable structure, in world units."""

    cores: int
    """Core points where both periods have a surface."""
    stable: int
    """Core points that one common shift explains: all of them if nothing changed."""
    median: float
    """Median absolute distance over stable core points."""
    level: float
    """Median level of detection; smaller distances are not significant."""
    beyond: float
    """Share of the stable core points beyond their level of detection."""
    shift: Interval
    """Translation that would bring the clouds together, with its 95% interval."""
    motion: Motion | None = None
    """Similarity that would, which owes nothing to matches."""


def surface_distance(
    first: PlacedPoints,
    second: PlacedPoints,
    centre: Array,
    registration: float,
    like: Motion | None = None,
) -> SurfaceDistance | str:
    """Compare the point clouds of two periods; the reason, where that is not possible.

    Args:
        first: Points placed by the images of one period.
        second: Points placed by the images of the other.
        centre: Some camera centre: normals are turned to it. [3]
        registration: Standard deviation of the alignment, in world units.
        like: Motion whose point and cameras that of the surfaces is to have; None for no motion.
    """
    from scipy.spatial import cKDTree

    if min(len(first.xyz), len(second.xyz)) < NEIGHBOURS:
        return f"{len(first.xyz)} and {len(second.xyz)} points: too few for surfaces"
    trees = cKDTree(first.xyz), cKDTree(second.xyz)
    step = len(second.xyz) // MAX_CORES + 1
    cores = second.xyz[::step]
    near, patch = trees[0].query(cores, NEIGHBOURS)
    radius = near[:, -1]
    own, mine = trees[1].query(cores, NEIGHBOURS)
    mean, normal, spread = _planes(first.xyz[patch])
    normal *= np.where(((centre - mean) * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    inside = own <= radius[:, None]
    # Core points off the edge of the first surface have all their neighbours on one side.
    across = mean - cores - ((mean - cores) * normal).sum(axis=1, keepdims=True) * normal
    usable = spread < MAX_ROUGHNESS * radius
    usable &= np.linalg.norm(across, axis=1) < 0.5 * radius
    usable &= inside.sum(axis=1) >= MIN_NEIGHBOURS
    usable &= radius < _max_radius(first.xyz, trees[0])
    if usable.sum() < MIN_CORES:
        return f"both periods have a surface at only {int(usable.sum())} core points"
    along = ((second.xyz[mine] - mean[:, None]) * normal[:, None]).sum(axis=2)
    distance, other, count = _mean_within(along[usable], inside[usable])
    chance = np.sqrt(spread[usable] ** 2 / NEIGHBOURS + other**2 / count)
    mean, normal = mean[usable], normal[usable]
    stable = _stable(distance, normal, chance)
    if stable.sum() < MIN_CORES:
        return f"only {int(stable.sum())} core points on structure that did not change"
    distance, chance, normal, mean = (x[stable] for x in (distance, chance, normal, mean))
    found = _summary(len(stable), distance, normal, chance, registration)
    if like is None:
        return found
    facing = np.einsum("ni,nij->nj", normal, generators(mean - like.middle))
    motion, covariance = _solve(distance, facing, chance)
    return replace(found, motion=replace(like, step=motion, covariance=covariance))


def _planes(patches: Array) -> tuple[Array, Array, Array]:
    """Mean, unit normal and deviation along it of patches. [K, n, 3]"""
    mean = patches.mean(axis=1)
    away = patches - mean[:, None]
    values, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", away, away) / patches.shape[1])
    return mean, vectors[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0.0))


def _max_radius(points: Array, tree: object) -> float:
    """Patches much wider than usual lie where the cloud has holes."""
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
    cores: int, distance: Array, normal: Array, chance: Array, registration: float
) -> SurfaceDistance:
    """Figures of the core points that did not change."""
    level = CONFIDENCE * chance + registration
    size = np.abs(distance)
    return SurfaceDistance(
        cores=cores,
        stable=len(distance),
        median=float(np.median(size)),
        level=float(np.median(level)),
        beyond=float(np.mean(size > level)),
        shift=_shift(distance, normal, chance),
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

    A direction that no surface faces (such as along a street) gets a wide interval.
    """
    t, covariance = _solve(distance, normal, chance)
    spread = CONFIDENCE * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    value = float(np.linalg.norm(t))
    return Interval(value, low=max(0.0, value - spread), high=value + spread)


def _solve(distance: Array, facing: Array, chance: Array) -> tuple[Array, Array]:
    """Parameters with ``facing @ parameters = distance``, reweighted, and their covariance.

    Args:
        distance: Along the normals. [K]
        facing: Its derivatives. [K, n]
        chance: Standard deviation of a distance. [K]
    """
    weight = 1.0 / np.maximum(chance, np.median(chance) * 0.1) ** 2
    # A prior for what no surface determines; parameters differ in unit.
    prior = 1e-6 * weight.sum() * np.diag(np.maximum((facing**2).mean(axis=0), 1e-12))
    robust = np.ones(len(distance))
    for _ in range(5):
        w = weight * robust
        left = np.einsum("ni,n,nj->ij", facing, w, facing) + prior
        step = np.linalg.solve(left, facing.T @ (w * distance))
        residual = (distance - facing @ step) * np.sqrt(weight)
        scale = max(float(SIGMA * np.median(np.abs(residual))), 1e-12)
        robust = 1.0 / (1.0 + (residual / (2 * scale)) ** 2)
    # Neighbouring patches share points: about NEIGHBOURS core points make one independent one.
    return step, np.linalg.inv(left) * scale**2 * NEIGHBOURS
