"""Roads, pavements, and the countryside around the city."""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from chronoscene.synth.city import palettes as pal
from chronoscene.synth.city.buildings import SLAB, Building, finished
from chronoscene.synth.city.vegetation import tree
from chronoscene.synth.city.world import World
from chronoscene.synth.render.mesh import Part, PartBuilder, srgb
from chronoscene.synth.render.noise import key_number, rng_for
from chronoscene.synth.render.textures import FIELDS, PAVING

Array = NDArray[np.float64]
X, Y, Z = np.eye(3)
PARKING = 2.0
"""Width of the parking lane at each side of a road."""
FAR = 900.0
"""Half the extent of the countryside."""


def road_network(world: World, xs: Array, ys: Array, width: float) -> None:
    """Roads between the columns and rows of blocks, junctions and zebra crossings."""
    b = PartBuilder(key_number("roads"))
    lanes = pal.asphalt_style(b, 1, PARKING)
    bare = pal.asphalt_style(b, 0)
    zebra = pal.asphalt_style(b, 2)
    for i in range(len(xs) - 1):
        x0, x1 = xs[i, 1], xs[i + 1, 0]
        for j, (y0, y1) in enumerate(ys):
            b.quads([x1, y0, 0], (y1 - y0) * Y, (x0 - x1) * X, lanes, seed=i)
            for y in (y0 + 1.0, y1 - 4.0):
                if 0 < j < len(ys) - 1:
                    b.quads([x1, y, 0.012], 3.0 * Y, (x0 - x1) * X, zebra)
            if 0 < j < len(ys) - 1:
                _centre_line(world, ((x0 + x1) / 2, y0), ((x0 + x1) / 2, y1))
        for j in range(len(ys) - 1):
            y0, y1 = ys[j, 1], ys[j + 1, 0]
            b.quads([x0, y0, 0], (x1 - x0) * X, (y1 - y0) * Y, bare, seed=j)
    for j in range(len(ys) - 1):
        y0, y1 = ys[j, 1], ys[j + 1, 0]
        for i, (x0, x1) in enumerate(xs):
            b.quads([x0, y0, 0], (x1 - x0) * X, (y1 - y0) * Y, lanes, seed=j + 40)
            for x in (x0 + 1.0, x1 - 4.0):
                if 0 < i < len(xs) - 1:
                    b.quads([x, y0, 0.012], 3.0 * X, (y1 - y0) * Y, zebra)
            if 0 < i < len(xs) - 1:
                _centre_line(world, (x0, (y0 + y1) / 2), (x1, (y0 + y1) / 2))
    world.always("roads", "ground", b.build)


def _centre_line(world: World, start: ArrayLike, end: ArrayLike) -> None:
    world.roads.append((np.asarray(start, float), np.asarray(end, float)))


def pavement(name: str, low: Array, high: Array, ring: float, seed: int) -> Part:
    """Kerb and slabs around a block; the inside stays open."""
    b = PartBuilder(key_number(name, "pavement"))
    rng = rng_for(seed, name, "pavement")
    grey = pal.tint(rng, srgb(158, 154, 146))
    light = pal.tint(rng, srgb(182, 174, 160))
    slabs = b.style(PAVING, grey, light, srgb(88, 84, 78), (0.6, 0.4, 0.5, 0.0, 1.0))
    kerb = b.style(PAVING, srgb(170, 168, 162), None, srgb(90, 88, 84), (1.0, 0.3, 0.0, 0, 1))
    dx, dy = high - low
    edge = 0.18
    up = SLAB * Z
    o = np.array([low[0], low[1], 0.0])
    for corner, along in ((o, dx * X), (o + dx * X, dy * Y), (o + dx * X + dy * Y, -dx * X),
                          (o + dy * Y, -dy * Y)):  # fmt: skip
        u = along / np.linalg.norm(along)
        inwards = np.cross(Z, u)
        b.quads(corner, along, up, kerb)
        b.quads(corner + up + edge * u, along - 2 * edge * u, edge * inwards, kerb)
        b.quads(corner + up, edge * u, edge * inwards, kerb)
        inner = corner + up + edge * inwards + edge * u
        b.quads(inner, along - (edge + ring) * u, (ring - edge) * inwards, slabs)
    return b.build()


def surroundings(world: World, xs: Array, ys: Array) -> None:
    """Hills with fields, and scattered farms and trees."""
    low, high = np.array([xs[0, 0], ys[0, 0]]), np.array([xs[-1, 1], ys[-1, 1]])
    rng = rng_for(world.seed, "surroundings")
    hills = _Hills(rng, low, high)
    world.always("country", "ground", lambda: _terrain(hills))
    count, half = 220, (high - low) / 2
    reach = half.max()
    for i in range(count):
        turn, r = rng.uniform(0, 2 * np.pi), reach * (1.5 + 2.6 * rng.random() ** 1.5)
        at = (low + high) / 2 + r * np.array([np.cos(turn), np.sin(turn)])
        if np.all(np.abs(at - (low + high) / 2) < half + 8):
            continue
        z = float(hills.height(at[None])[0])
        if rng.random() < 0.24:
            _farm(world, f"farm_{i}", at, z, rng)
        else:
            base = np.array([*at, z - 0.3])
            height = float(rng.uniform(7, 15))
            states = [(height, season) for season in world.seasons]
            label = f"far_tree_{i}"
            world.add(label, "tree", states, partial(tree, label, base, world.seed, 0, False))


def _farm(world: World, name: str, at: Array, z: float, rng: np.random.Generator) -> None:
    w, d = rng.uniform(8, 16, 2)
    spec = Building(
        name, at[0] - w / 2, at[1] - d / 2, at[0] + w / 2, at[1] + d / 2, int(rng.integers(1, 4)),
        str(rng.choice(["gable", "hip"])), str(rng.choice(["plaster", "brick"])), simple=True,
    )  # fmt: skip
    part = finished(spec, world.seed)
    part.vertices[..., 2] += np.float32(z - 0.8)
    part.patches[:, 2] += z - 0.8
    world.always(name, "building", lambda: part)


class _Hills:
    """Height of the countryside: flat at the city, hills farther out."""

    def __init__(self, rng: np.random.Generator, low: Array, high: Array) -> None:
        self._waves = rng.normal(0, 1, (7, 2)) / np.array([230, 180, 140, 110, 90, 70, 55])[:, None]
        self._phase = rng.uniform(0, 6.28, 7)
        self._middle, self._half = (low + high) / 2, (high - low) / 2

    def height(self, xy: Array) -> Array:
        """Metres above the city's ground. [N]"""
        outside = np.maximum(np.abs(xy - self._middle) - self._half, 0)
        distance = np.hypot(outside[:, 0], outside[:, 1])
        sizes = np.array([9, 8, 6, 4, 3, 2, 1.5])
        bumps = (np.sin(xy @ self._waves.T + self._phase) * sizes).sum(axis=1)
        far = np.clip((distance - 25) / 320, 0, 1)
        rise = 34 * np.clip((distance - 120) / 700, 0, 1) ** 1.3
        height: Array = -0.35 + far * (10 + bumps) + rise
        return height


def _terrain(hills: _Hills) -> Part:
    """Grid with smooth normals, finer near the city."""
    b = PartBuilder(key_number("country"))
    fields = b.style(FIELDS, srgb(104, 120, 62), srgb(164, 152, 96), srgb(128, 104, 76))
    t = np.linspace(-1, 1, 121)
    line = FAR * (0.45 * t + 0.55 * t**3)
    xy = np.stack(np.meshgrid(line, line, indexing="ij"), -1)
    flat = xy.reshape(-1, 2)
    z = hills.height(flat)
    e = 2.0
    east, north = np.array([e, 0]), np.array([0, e])
    sx = (hills.height(flat + east) - hills.height(flat - east)) / (2 * e)
    sy = (hills.height(flat + north) - hills.height(flat - north)) / (2 * e)
    normals = np.stack([-sx, -sy, np.ones_like(sx)], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    points = np.column_stack([flat, z])
    n = len(line)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + n + 1], 1), np.stack([i, i + n + 1, i + 1], 1)])
    b.triangles(points[faces], normals[faces], fields, origin=np.zeros(3))
    return b.build()
