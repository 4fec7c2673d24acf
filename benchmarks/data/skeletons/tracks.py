"""Points of a skeleton with their tracks, consistent with its cameras.

Nothing hides anything here: a camera may observe what projects into its image.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.data.skeletons.geometry import NO_HOUSE, Houses, Surface, sample_surface
from chronoscene.arrays import Array, Ints, Mask
from chronoscene.scene import Camera

NEAREST = 8
"""Cameras per point that may observe it."""
LEAST_TRACK, LONGEST_TRACK = 3, 6
"""Observations of a point in its own period."""
SHARED = 0.3
"""Share of points that another period observes, too, but less often."""
NOISE = 0.2
"""Standard deviation of an observed position in pixels, along each axis."""
LARGEST_RESIDUAL = 0.9
"""Pixels."""
MOST_ROUNDS = 50


@dataclass(frozen=True, slots=True, eq=False)
class Flight:
    """Cameras of one period (n of them)."""

    camera: Camera
    poses: Array
    """[n, 4, 4]"""
    targets: cKDTree
    """Places on the ground that they look at."""
    first_image: int
    """Index of the first camera among those of all periods."""


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """Observations (M of them), without order."""

    point: Ints
    image: Ints
    """Index among the images of all periods."""
    exact: Array
    """Projections of the points, in pixels. [M, 2]"""

    def shifted(self, points: int) -> Tracks:
        """Return the tracks with point indices increased by ``points``."""
        return Tracks(self.point + points, self.image, self.exact)

    @classmethod
    def join(cls, parts: Sequence[Tracks]) -> Tracks:
        return cls(*(np.concatenate([getattr(p, k) for p in parts]) for k in cls.__slots__))


def make_tracks(
    houses: Houses, flights: Sequence[Flight], counts: Sequence[int], rng: np.random.Generator
) -> tuple[Surface, Tracks]:
    """Points that are counted in each period exactly so often, and their tracks.

    The own period of a point observes it more often than any other does.

    Args:
        houses: What is there.
        flights: One per period.
        counts: Points of each period.
        rng: Source of everything.
    """
    surfaces, tracks, first_point = [], [], 0
    for period, count in enumerate(counts):
        surface, own = _period_points(houses, flights[period], period, count, rng)
        shared = _shared(houses, flights, period, surface, own, rng)
        tracks += [part.shifted(first_point) for part in (own, *shared)]
        surfaces.append(surface)
        first_point += count
    return Surface.join(surfaces), Tracks.join(tracks)


def add_noise(tracks: Tracks, camera: Camera, rng: np.random.Generator) -> Array:
    """Observed positions: at most `LARGEST_RESIDUAL` off, and inside the image. [M, 2]"""
    shift = rng.normal(0, NOISE, tracks.exact.shape)
    length = np.linalg.norm(shift, axis=1, keepdims=True)
    shift *= np.minimum(1.0, LARGEST_RESIDUAL / np.maximum(length, 1e-12))
    size = np.array([camera.width, camera.height])
    return np.clip(tracks.exact + shift, 0.0, size - 1e-6)


def _period_points(
    houses: Houses, flight: Flight, period: int, count: int, rng: np.random.Generator
) -> tuple[Surface, Tracks]:
    """Points of one period, each with `LEAST_TRACK` to `LONGEST_TRACK` observations in it."""
    least = min(LEAST_TRACK, len(flight.poses))
    surfaces, tracks, found = [], [], 0
    for _ in range(MOST_ROUNDS):
        some = sample_surface(houses, period, int(1.1 * (count - found)) + 16, rng)
        images, exact, visible = _project_nearest(flight, some.xyz)
        good = np.flatnonzero(visible.sum(axis=1) >= least)[: count - found]
        wanted = rng.integers(least, LONGEST_TRACK + 1, len(good))
        part = _choose(images[good], exact[good], visible[good], wanted, rng)
        tracks.append(part.shifted(found))
        surfaces.append(some[good])
        found += len(good)
        if found == count:
            break
    assert found == count, "the flight does not cover the place"
    return Surface.join(surfaces), Tracks.join(tracks)


def _shared(
    houses: Houses,
    flights: Sequence[Flight],
    period: int,
    surface: Surface,
    own: Tracks,
    rng: np.random.Generator,
) -> list[Tracks]:
    """Observations of some points in one other period, where the house still or already stands."""
    others = [p for p in range(len(flights)) if p != period]
    if not others:
        return []
    length = np.bincount(own.point, minlength=len(surface.xyz))
    other = rng.choice(others, len(length))
    stands = (surface.house == NO_HOUSE) | houses.built[other, surface.house]
    chosen = stands & (rng.random(len(length)) < SHARED)
    found = []
    for p in others:
        rows = np.flatnonzero(chosen & (other == p))
        images, exact, visible = _project_nearest(flights[p], surface.xyz[rows])
        wanted = rng.integers(1, np.maximum(2, length[rows]))
        wanted = np.minimum(wanted, length[rows] - 1)
        part = _choose(images, exact, visible, wanted, rng)
        found.append(Tracks(rows[part.point], part.image, part.exact))
    return found


def _project_nearest(flight: Flight, xyz: Array) -> tuple[Ints, Array, Mask]:
    """Project points into the cameras that look nearest to them.

    Returns:
        images: Index among the images of all periods. [n, k]
        exact: Pixels. [n, k, 2]
        visible: Whether the point is in front of the camera and inside its image. [n, k]
    """
    camera, k = flight.camera, min(NEAREST, len(flight.poses))
    _, slots = flight.targets.query(xyz[:, :2], k=np.arange(1, k + 1))
    size = np.array([camera.width, camera.height])
    exact = np.empty((len(xyz), k, 2))
    visible = np.empty((len(xyz), k), bool)
    for column in range(k):  # one at a time: a pose per point and camera would need gigabytes
        pose = flight.poses[slots[:, column]]
        local = np.einsum("nij,nj->ni", pose[:, :3, :3], xyz) + pose[:, :3, 3]
        depth = np.maximum(local[:, 2:], 1e-9)
        at = local[:, :2] / depth * camera.K[[0, 1], [0, 1]] + camera.K[:2, 2]
        exact[:, column] = at
        visible[:, column] = (local[:, 2] > 1.0) & ((at >= 0) & (at < size)).all(axis=1)
    return slots + flight.first_image, exact, visible


def _choose(
    images: Ints, exact: Array, visible: Mask, wanted: Ints, rng: np.random.Generator
) -> Tracks:
    """A random choice of at most so many visible cameras of each point."""
    keys = np.where(visible, rng.random(visible.shape), 2.0)
    order = np.argsort(keys, axis=1)
    length = np.minimum(wanted, visible.sum(axis=1))
    rows, places = np.nonzero(np.arange(images.shape[1]) < length[:, None])
    columns = order[rows, places]
    return Tracks(rows, images[rows, columns], exact[rows, columns])
