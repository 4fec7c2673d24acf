"""Content of a skeleton: a block city that changes, flights over it, points on its surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array, Ints, Mask
from chronoscene.scene import Camera
from chronoscene.scene.geometry import pose_from_rotation_translation

EXTENT = 200.0
"""Edge of the place in metres."""
BLOCKS = 9
"""Blocks per axis; each has one house."""
FIELD_OF_VIEW = np.deg2rad(70.0)
"""Horizontal."""
HEIGHT_IN_SPACINGS = 5.5
"""Flying height in mean distances between cameras: then the nearest cameras see a point."""
NO_HOUSE = -1


@dataclass(frozen=True, slots=True, eq=False)
class Houses:
    """One house per block (H of them)."""

    centre: Array
    """[H, 2]"""
    half: Array
    """Half of the edges. [H, 2]"""
    height: Array
    """[H]"""
    built: Mask
    """True if the house stands in a period. [T, H]"""


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Sampled points (n of them)."""

    xyz: Array
    """[n, 3]"""
    rgb: Array
    """0..255. [n, 3]"""
    house: Ints
    """House that the point is on, or `NO_HOUSE`. [n]"""

    def __getitem__(self, rows: Ints) -> Surface:
        return Surface(self.xyz[rows], self.rgb[rows], self.house[rows])

    @classmethod
    def join(cls, parts: Sequence[Surface]) -> Surface:
        return cls(*(np.concatenate([getattr(p, k) for p in parts]) for k in cls.__slots__))


def make_camera(width: int, height: int) -> Camera:
    """The one camera of a skeleton."""
    focal = width / 2 / np.tan(FIELD_OF_VIEW / 2)
    return Camera(1, "PINHOLE", width, height, (focal, focal, width / 2, height / 2))


def make_houses(periods: int, rng: np.random.Generator) -> Houses:
    """Houses of which some are built or torn down between periods."""
    count, edge = BLOCKS * BLOCKS, EXTENT / BLOCKS
    corner = np.stack(np.meshgrid(np.arange(BLOCKS), np.arange(BLOCKS), indexing="ij"), -1)
    half = rng.uniform(0.16, 0.34, (count, 2)) * edge
    centre = (corner.reshape(-1, 2) + 0.5) * edge + rng.uniform(-0.1, 0.1, (count, 2)) * edge
    height = rng.gamma(4.0, 2.6, count) + 3.0
    return Houses(centre, half, height, rng.random((periods, count)) < 0.8)


def make_poses(count: int, height: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Cameras of one flight: poses and the places on the ground that they look at.

    The places follow the additive recurrence of the plastic number, which covers a square evenly
    for any count, and are numbered along strips.

    Args:
        count: Number of cameras, n.
        height: Flying height in metres.
        rng: Source of offset, tilt and heading.

    Returns:
        cam_from_world: [n, 4, 4]
        targets: Metres. [n, 2]
    """
    plastic = 1.324717957244746
    steps = np.arange(1, count + 1)[:, None] * [1 / plastic, 1 / plastic**2]
    targets = (steps + rng.random(2)) % 1.0
    strip = np.floor(targets[:, 0] * np.sqrt(count))
    targets = EXTENT * targets[np.lexsort((targets[:, 1], strip))]
    heading = rng.uniform(0, 2 * np.pi, count)
    tilt = np.tan(rng.uniform(0.0, 0.35, count))
    ahead = np.column_stack([np.cos(heading), np.sin(heading)])
    above = height * rng.uniform(0.95, 1.05, count)
    centres = np.column_stack([targets - (above * tilt)[:, None] * ahead, above])
    forward = np.column_stack([targets, np.zeros(count)]) - centres
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    right = np.column_stack([ahead[:, 1], -ahead[:, 0], np.zeros(count)])
    rotation = np.stack([right, np.cross(forward, right), forward], axis=1)
    translation = -np.einsum("nij,nj->ni", rotation, centres)
    poses = [
        pose_from_rotation_translation(r, t) for r, t in zip(rotation, translation, strict=True)
    ]
    return np.array(poses), targets


def flying_height(counts: Sequence[int]) -> float:
    """Height at which the flight with the fewest cameras still sees every place several times."""
    return HEIGHT_IN_SPACINGS * EXTENT / float(np.sqrt(min(counts)))


def sample_surface(houses: Houses, period: int, count: int, rng: np.random.Generator) -> Surface:
    """Points on ground and roofs, on walls and in trees of one period."""
    on_walls, in_trees = int(0.4 * count), int(0.12 * count)
    parts = [
        _from_above(houses, period, count - on_walls - in_trees, rng),
        _walls(houses, period, on_walls, rng),
        _trees(in_trees, rng),
    ]
    every = Surface.join(parts)
    noise = rng.normal(0, 12, (count, 3)) + rng.normal(0, 18, (count, 1))
    return Surface(every.xyz, np.clip(every.rgb + noise, 0, 255), every.house)[
        rng.permutation(count)
    ]


def _relief(xy: Array) -> Array:
    """Height of the ground. [n, 2] -> [n]"""
    x, y = 2 * np.pi * xy.T / EXTENT
    return np.asarray(1.5 * np.sin(x + 0.7) + np.sin(2 * y) + 0.6 * np.cos(3 * x - y))


def _from_above(houses: Houses, period: int, count: int, rng: np.random.Generator) -> Surface:
    xy = rng.uniform(0, EXTENT, (count, 2))
    cell = np.minimum((xy / (EXTENT / BLOCKS)).astype(np.int64), BLOCKS - 1)
    house = cell[:, 0] * BLOCKS + cell[:, 1]
    inside = (np.abs(xy - houses.centre[house]) < houses.half[house]).all(axis=1)
    inside &= houses.built[period, house]
    z = np.where(inside, houses.height[house], _relief(xy))
    rgb = np.where(inside[:, None], [168, 92, 78], [124, 132, 104])
    return Surface(np.column_stack([xy, z]), rgb.astype(float), np.where(inside, house, NO_HOUSE))


def _walls(houses: Houses, period: int, count: int, rng: np.random.Generator) -> Surface:
    area = houses.half.sum(axis=1) * houses.height * houses.built[period]
    if not area.any():
        return _from_above(houses, period, count, rng)
    house = rng.choice(len(area), count, p=area / area.sum())
    half = houses.half[house]
    along_x = rng.random(count) * half.sum(axis=1) < half[:, 0]
    side = rng.choice([-1.0, 1.0], count)
    free = rng.uniform(-1, 1, count)
    xy = np.where(along_x, [free, side], [side, free]).T * half + houses.centre[house]
    z = rng.random(count) * houses.height[house]
    rgb = np.full((count, 3), (186.0, 174.0, 150.0))
    return Surface(np.column_stack([xy, z]), rgb, house)


def _trees(count: int, rng: np.random.Generator) -> Surface:
    # Trees stand on the streets, so they are there in every period.
    places = np.random.default_rng(BLOCKS).uniform(0, EXTENT, (120, 2))
    edge = EXTENT / BLOCKS
    places[:, 0] = np.round(places[:, 0] / edge) * edge
    at = np.clip(places[rng.integers(0, len(places), count)], 2.0, EXTENT - 2.0)
    xyz = np.column_stack([at, _relief(at) + 4.0]) + rng.normal(0, (0.9, 0.9, 1.2), (count, 3))
    return Surface(xyz, np.full((count, 3), (70.0, 104.0, 52.0)), np.full(count, NO_HOUSE))
