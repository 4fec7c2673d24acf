"""Ground of blocks: rectangles, their surfaces, and pavements around them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, X, Y, Z, srgb
from chronoscene.synth.render.noise import key_number, rng_for
from chronoscene.synth.render.textures import PAVING

SLAB = 0.15  # Height of pavements above the road

PATTERNS = {
    "rings": (srgb(184, 160, 132), srgb(132, 92, 74), srgb(96, 84, 72), (0.8, 0.8, 0.5, 2.0, 4.4)),
    "bands": (srgb(176, 168, 154), srgb(118, 112, 108), srgb(84, 80, 76), (0.6, 0.6, 0, 1.0, 4.8)),
    "slabs": (srgb(168, 150, 128), srgb(150, 140, 128), srgb(92, 84, 74), (0.4, 0.2, 0.5, 0, 1.0)),
}
"""Colours and numbers of paved surfaces."""


@dataclass(frozen=True, slots=True)
class Rect:
    """Axis-aligned rectangle in metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    @classmethod
    def around(cls, centre: Array, half: float) -> Rect:
        """A square around a point; ``half`` is half of its edge."""
        return cls(centre[0] - half, centre[1] - half, centre[0] + half, centre[1] + half)

    def inset(self, d: float) -> Rect:
        return Rect(self.x0 + d, self.y0 + d, self.x1 - d, self.y1 - d)

    @property
    def size(self) -> tuple[float, float]:
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def center(self) -> tuple[float, float]:
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def at(self, fx: float, fy: float, z: float = SLAB) -> Array:
        """Point at fractions of the width and depth. [3]"""
        dx, dy = self.size
        return np.array([self.x0 + fx * dx, self.y0 + fy * dy, z])


def floor(name: str, rect: Rect, surface: str, *, z: float = SLAB) -> Mesh:
    """A rectangle of ground.

    Args:
        name: Name of the block or object, which determines the texture.
        rect: The rectangle.
        surface: ``lawn SEASON``, ``mown SEASON``, ``soil``, ``car_park``, ``rings``, ``bands`` or
            ``slabs``.
        z: Height in metres.
    """
    b = MeshBuilder(key_number(name, "floor"))
    kind, _, season = surface.partition(" ")
    dx, dy = rect.size
    if kind in PATTERNS:
        style = b.style(PAVING, *PATTERNS[kind])
    elif kind == "lawn":
        style = pal.grass_style(b, season, wear=0.22)
    elif kind == "mown":
        style = pal.grass_style(b, season, wear=0.10, stripes=0.22)
    elif kind == "soil":
        style = pal.soil_style(b, stones=0.10, ruts=0.8)
    else:
        assert kind == "car_park"
        style = pal.asphalt_style(b, 3)
    b.quads([rect.x0, rect.y0, z], dx * X, dy * Y, style)
    return b.build()


def pavement(name: str, rect: Rect, ring: float, seed: int) -> Mesh:
    """Kerb and a ring of paving slabs along the inside of the edges of a block."""
    b = MeshBuilder(key_number(name, "pavement"))
    rng = rng_for(seed, name, "pavement")
    grey = pal.tint(rng, srgb(158, 154, 146))
    light = pal.tint(rng, srgb(182, 174, 160))
    slabs = b.style(PAVING, grey, light, srgb(88, 84, 78), (0.6, 0.4, 0.5, 0.0, 1.0))
    kerb = b.style(PAVING, srgb(170, 168, 162), None, srgb(90, 88, 84), (1.0, 0.3, 0.0, 0, 1))
    dx, dy = rect.size
    edge = 0.18
    up = SLAB * Z
    o = np.array([rect.x0, rect.y0, 0.0])
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
