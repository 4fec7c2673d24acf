"""Trees and hedges: lumpy balls fringed with loose leaves."""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, Z, cross, srgb
from chronoscene.synth.render.noise import key_number, rng_for


@cache
def icosphere(level: int) -> tuple[Array, NDArray[np.int64]]:
    """Unit sphere of 20 * 4**level triangles. [V, 3], [F, 3]"""
    g = (1 + 5**0.5) / 2
    first = [(-1, g, 0), (1, g, 0), (-1, -g, 0), (1, -g, 0)]
    vertices = np.concatenate([np.roll(first, i, axis=1) for i in range(3)]) / np.sqrt(1 + g * g)
    f = [(0, 11, 5), (0, 5, 1), (0, 1, 7), (0, 7, 10), (0, 10, 11), (1, 5, 9), (5, 11, 4)]
    f += [(11, 10, 2), (10, 7, 6), (7, 1, 8), (3, 9, 4), (3, 4, 2), (3, 2, 6), (3, 6, 8)]
    f += [(3, 8, 9), (4, 9, 5), (2, 4, 11), (6, 2, 10), (8, 6, 7), (9, 8, 1)]
    faces = np.array(f)
    for _ in range(level):
        a, b, c = (vertices[faces[:, i]] for i in range(3))
        mids = np.concatenate([a + b, b + c, c + a])
        mids /= np.linalg.norm(mids, axis=1, keepdims=True)
        n, m = len(vertices), len(faces)
        ab, bc, ca = (n + i * m + np.arange(m) for i in range(3))
        i, j, k = faces.T
        rows = [(i, ab, ca), (ab, j, bc), (ca, bc, k), (ab, bc, ca)]
        faces = np.concatenate([np.stack(r, axis=1) for r in rows])
        vertices = np.concatenate([vertices, mids])
    return vertices, faces


class Foliage(MeshBuilder):
    """Builder of a plant from lumpy balls and loose leaves.

    Normals lean away from the ``heart`` of a crown, so that the crown is shaded as one volume.

    Args:
        name: Name of the plant.
        rng: Draws the shape.
    """

    def __init__(self, name: str, rng: np.random.Generator) -> None:
        super().__init__(key_number(name))
        self.rng = rng

    def ball(
        self, center: Array, radii: Array, heart: Array, leaf: int, level: int, rough: float = 0.16
    ) -> None:
        """Lumpy ball of 20 * 4**level triangles."""
        v, f = icosphere(level)
        # Bumps depend on the direction alone, so faces that share a corner stay joined.
        waves = self.rng.normal(0, 2.6, (4, 3))
        phase = self.rng.uniform(0, 6.28, 4)
        bumps = 1 + rough * np.sin(v @ waves.T + phase).sum(axis=1) / 1.6
        points = center + radii * v * bumps[:, None]
        normals = 0.65 * v + 0.5 * _unit(points - heart) + self.rng.normal(0, 0.12, v.shape)
        self.triangles(points[f], _unit(normals)[f], leaf, origin=heart)

    def leaves(
        self, center: Array, radii: Array, heart: Array, leaf: int, count: int, size: float
    ) -> None:
        """Loose triangles on the surface of a ball."""
        rng = self.rng
        out = _unit(rng.normal(0, 1, (count, 3)))
        at = center + radii * out * rng.uniform(0.9, 1.18, (count, 1))
        e = _unit(rng.normal(0, 1, (count, 3)) + 0.4 * out)
        side = _unit(cross(e, rng.normal(0, 1, (count, 3))))
        s = size * rng.uniform(0.6, 1.4, (count, 1))
        tris = np.stack([at - 0.5 * s * e, at + 0.5 * s * e, at + 0.8 * s * side], axis=1)
        normals = _unit(0.8 * _unit(at - heart) + 0.4 * out + rng.normal(0, 0.2, out.shape))
        self.triangles(tris, np.repeat(normals[:, None], 3, axis=1), leaf, origin=heart)


def trunk(b: MeshBuilder, base: Array, top: Array, radius: float, style: int) -> None:
    """Tapered stem with seven sides."""
    turn = np.linspace(0, 2 * np.pi, 8)
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(8)])
    low, high = base + radius * ring, top + 0.5 * radius * ring
    b.triangles(_facets(low, high), _facets(ring, ring), style, origin=base)


def _facets(low: Array, high: Array) -> Array:
    """Two triangles between each pair of neighbours on two rings. [N, 3, 3]"""
    quads = np.stack([low[:-1], low[1:], high[1:], high[:-1]], axis=1)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


def tree(
    name: str, base: Array, seed: int, detail: int, broad: bool, state: tuple[float, str]
) -> Mesh:
    """A tree; name and seed determine species and shape, the state its height and season.

    Args:
        name: Name of the tree.
        base: Foot of the stem. [3]
        seed: Seed of the scene.
        detail: Level of detail: 0 far away, 1 at middle distance, 2 near.
        broad: Whether to exclude conifers, which would block a street.
        state: Height in metres, and season, which determines the colours.
    """
    height, season = state
    rng = rng_for(seed, name, "tree")
    b = Foliage(name, rng)
    species = int(rng.choice(3, p=[0.45, 0.4, 0.15]))
    species = species % 2 if broad else species
    bark = pal.plain_style(b, srgb(96, 78, 60), strength=0.5, size=0.2)
    leaf = pal.leaf_style(b, season, species, 0.24 if detail == 2 else 0.5)
    lean = rng.normal(0, 0.03, 2) * height
    top = base + np.array([lean[0], lean[1], 0.75 * height])
    trunk(b, base, top, 0.022 * height + 0.05, bark)
    if species == 2:
        _conifer(b, base, height, leaf, detail)
    elif season == "winter":
        _bare(b, base, top, height, bark, leaf)
    else:
        _broadleaf(b, base, top, height, leaf, detail)
    return b.build()


def _conifer(b: Foliage, base: Array, height: float, leaf: int, detail: int) -> None:
    """Tiers that narrow towards the top."""
    tiers = (3, 5, 6)[detail]
    heart = base + 0.4 * height * Z
    for i in range(tiers):
        f = i / tiers
        center = base + height * (0.24 + 0.7 * f) * Z
        r = 0.24 * height * (1.05 - f)
        radii = np.array([r, r, 0.13 * height * (1.2 - 0.5 * f)])
        b.ball(center, radii, heart, leaf, detail, rough=0.28)
        if detail == 2:
            b.leaves(center, radii, heart, leaf, count=70, size=0.5)


def _bare(b: Foliage, base: Array, top: Array, height: float, bark: int, leaf: int) -> None:
    """Branches with twigs, and a few brown leaves left."""
    rng, stem = b.rng, top - base
    for _ in range(9):
        start = base + stem * rng.uniform(0.45, 1.0)
        way = _unit(rng.normal(0, 1, 3) * [1, 1, 0.4] + 0.7 * Z)
        length = height * rng.uniform(0.22, 0.36)
        end = start + length * way
        trunk(b, start, end, 0.010 * height, bark)
        for _ in range(5):
            fork = start + rng.uniform(0.3, 1.0) * length * way
            out = _unit(way + rng.normal(0, 0.6, 3) + 0.2 * Z)
            tip = fork + 0.45 * length * out
            trunk(b, fork, tip, 0.005 * height, bark)
            b.leaves(tip, np.full(3, 0.09 * height), base, bark, count=9, size=0.5)
    b.leaves(top, np.full(3, 0.2 * height), base, leaf, count=30, size=0.3)


def _broadleaf(b: Foliage, base: Array, top: Array, height: float, leaf: int, detail: int) -> None:
    """Balls scattered in an ellipsoid around the upper stem."""
    rng = b.rng
    slim = rng.random() < 0.25
    wide = (0.17 if slim else 0.36) * height
    tall = (0.40 if slim else 0.35) * height
    heart = np.array([top[0], top[1], base[2] + height - tall])
    for i in range((3, 7, 13)[detail]):
        out = _unit(rng.normal(0, 1, 3)) * rng.uniform(0.5, 0.75)
        center = heart + out * [wide, wide, tall] if i else heart
        r = (0.62 if i == 0 else rng.uniform(0.36, 0.5)) * np.array([wide, wide, 0.85 * tall])
        r = np.maximum(r, 0.3 * wide)
        b.ball(center, r, heart, leaf, detail)
        if detail == 2:
            b.leaves(center, r, heart, leaf, count=int(40 + 30 * min(4.0, r[0])), size=0.42)


def hedge(name: str, low: Array, high: Array, seed: int, season: str) -> Mesh:
    """A row of balls between two points."""
    b = Foliage(name, rng_for(seed, name, "hedge"))
    leaf = pal.leaf_style(b, season, 1, 0.2)
    count = max(1, int(float(np.linalg.norm((high - low)[:2])) / 0.9))
    for i in range(count):
        f = (i + 0.5) / count
        c = low + f * (high - low)
        c = np.array([c[0], c[1], low[2] + 0.45 + b.rng.uniform(-0.05, 0.08)])
        b.ball(c, np.array([0.62, 0.62, 0.6]), c - 0.5 * Z, leaf, level=2)
        b.leaves(c, np.full(3, 0.62), c, leaf, count=24, size=0.3)
    return b.build()


def _unit(v: Array) -> Array:
    unit: Array = v / np.sqrt(np.maximum((v * v).sum(axis=-1, keepdims=True), 1e-18))
    return unit
