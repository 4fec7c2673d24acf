"""Distance between the surfaces that two periods see, without any match between them.

Every point is placed by the images of one period alone. Around core points of one cloud, both
clouds are averaged along the local normal; what is left is compared with the level of detection,
``1.96 (sqrt(s1^2 / n1 + s2^2 / n2) + registration error)``.

Source: Lague, Brodu and Leroux 2013 (M3C2). Ours takes a fixed number of neighbours within a radius
instead of a cylinder, because sparse clouds differ widely in density.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from chronoscene.arrays import Array, Mask
from chronoscene.registration.quality.misalignment import MANY, Interval, Motion, generators
from chronoscene.registration.quality.rays import PlacedPoints
from chronoscene.scene.similarity import SIGMA

NEIGHBOURS = 16  # Points in a patch of a cloud
FINER = (10, 6)
"""Points in the patches by which the similarity is measured as well; the most certain one counts.
Wide patches reach farther, and show large steps of repeated structure. Small ones mix fewer
surfaces at edges, and fit on a wall: where clouds are smooth, they leave a third of the error."""
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
    if min(len(first.xyz), len(second.xyz)) < NEIGHBOURS:
        return f"{len(first.xyz)} and {len(second.xyz)} points: too few for surfaces"
    trees = cKDTree(first.xyz), cKDTree(second.xyz)
    usable = _patches(first.xyz, second.xyz, trees, centre, NEIGHBOURS)
    if len(usable) < MIN_CORES:
        return f"both periods have a surface at only {len(usable)} core points"
    stable = usable.where(_stable(usable))
    if len(stable) < MIN_CORES:
        return f"only {len(stable)} core points on structure that did not change"
    found = _summary(len(usable), stable, registration)
    if like is None:
        return found
    motion = _similarity(stable, NEIGHBOURS, like)
    for size in FINER:
        fine = _patches(first.xyz, second.xyz, trees, centre, size)
        if len(fine) >= MIN_CORES:
            fine = fine.where(_stable(fine))
        if len(fine) >= MIN_CORES:
            motion = min(motion, _similarity(fine, size, like), key=_uncertainty)
    return replace(found, motion=motion)


def _similarity(patches: _Patches, size: int, like: Motion) -> Motion:
    """Similarity that would bring the clouds together."""
    facing = np.einsum("ni,nij->nj", patches.normal, generators(patches.mean - like.middle))
    step, covariance = _solve(patches.distance, facing, patches.chance, size)
    return replace(like, step=step, covariance=covariance, freedom=MANY)


def _uncertainty(motion: Motion) -> float:
    """Logarithm of the volume in which the parameters lie."""
    return float(np.linalg.slogdet(motion.covariance)[1])


@dataclass(frozen=True, slots=True, eq=False)
class _Patches:
    """Patches of the first cloud with core points of the second (K patches)."""

    distance: Array
    """Between the clouds, along the normals. [K]"""
    normal: Array
    """[K, 3]"""
    chance: Array
    """Standard deviation of a distance. [K]"""
    mean: Array
    """[K, 3]"""

    def __len__(self) -> int:
        return len(self.distance)

    def where(self, mask: Mask) -> _Patches:
        """Some of the patches."""
        return _Patches(*(getattr(self, name)[mask] for name in self.__slots__))


def _patches(
    first: Array, second: Array, trees: tuple[cKDTree, cKDTree], centre: Array, size: int
) -> _Patches:
    """Compare clouds along the normals of patches, where both have a surface.

    Args:
        first: [N, 3]
        second: [M, 3]
        trees: Of both.
        centre: Some camera centre: normals are turned to it. [3]
        size: Points in a patch.
    """
    cores = second[:: len(second) // MAX_CORES + 1]
    near, patch = trees[0].query(cores, size)
    radius = near[:, -1]
    own, mine = trees[1].query(cores, size)
    mean, normal, spread = _planes(first[patch])
    normal *= np.where(((centre - mean) * normal).sum(axis=1) < 0, -1.0, 1.0)[:, None]
    inside = own <= radius[:, None]
    # Core points off the edge of the first surface have all their neighbours on one side.
    across = mean - cores - ((mean - cores) * normal).sum(axis=1, keepdims=True) * normal
    usable = spread < MAX_ROUGHNESS * radius
    usable &= np.linalg.norm(across, axis=1) < 0.5 * radius
    usable &= inside.sum(axis=1) >= MIN_NEIGHBOURS
    usable &= radius < _max_radius(first, trees[0], size)
    along = ((second[mine] - mean[:, None]) * normal[:, None]).sum(axis=2)
    distance, other, count = _mean_within(along[usable], inside[usable])
    chance = np.sqrt(spread[usable] ** 2 / size + other**2 / count)
    return _Patches(distance, normal[usable], chance, mean[usable])


def _planes(patches: Array) -> tuple[Array, Array, Array]:
    """Mean, unit normal and deviation along it of patches. [K, n, 3]"""
    mean = patches.mean(axis=1)
    away = patches - mean[:, None]
    values, vectors = np.linalg.eigh(np.einsum("kni,knj->kij", away, away) / patches.shape[1])
    return mean, vectors[:, :, 0], np.sqrt(np.maximum(values[:, 0], 0.0))


def _max_radius(points: Array, tree: cKDTree, size: int) -> float:
    """Patches much wider than usual lie where the cloud has holes."""
    some = points[:: len(points) // 1000 + 1]
    near = tree.query(some, size)[0][:, -1]
    return 3.0 * float(np.median(near))


def _mean_within(along: Array, inside: Mask) -> tuple[Array, Array, Array]:
    """Mean, standard deviation and number of the entries inside. [K, n] -> [K] each"""
    count = inside.sum(axis=1)
    mean = np.where(inside, along, 0.0).sum(axis=1) / count
    square = np.where(inside, (along - mean[:, None]) ** 2, 0.0).sum(axis=1)
    return mean, np.sqrt(square / (count - 1)), count.astype(np.float64)


def _summary(cores: int, stable: _Patches, registration: float) -> SurfaceDistance:
    """Figures of the core points that did not change."""
    level = CONFIDENCE * (stable.chance + registration)
    size = np.abs(stable.distance)
    return SurfaceDistance(
        cores=cores,
        stable=len(stable),
        median=float(np.median(size)),
        level=float(np.median(level)),
        beyond=float(np.mean(size > level)),
        shift=_shift(stable.distance, stable.normal, stable.chance),
    )


def _stable(patches: _Patches) -> Mask:
    """Core points that did not change: the largest set that one translation explains.

    Zero is preferred unless another translation explains notably more: three core points fix a
    translation, and the best of many triples is taken.
    """
    distance, normal, chance = patches.distance, patches.normal, patches.chance
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
    t, covariance = _solve(distance, normal, chance, NEIGHBOURS)
    spread = CONFIDENCE * float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    value = float(np.linalg.norm(t))
    return Interval(value, low=max(0.0, value - spread), high=value + spread)


def _solve(distance: Array, facing: Array, chance: Array, size: int) -> tuple[Array, Array]:
    """Parameters with ``facing @ parameters = distance``, reweighted, and their covariance.

    Args:
        distance: Along the normals. [K]
        facing: Its derivatives. [K, n]
        chance: Standard deviation of a distance. [K]
        size: Points in a patch.
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
    # Neighbouring patches share points: about ``size`` core points make one independent one.
    return step, np.linalg.inv(left) * scale**2 * size
