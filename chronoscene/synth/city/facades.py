"""Walls with recessed windows, sills, cornices, shop fronts and balconies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.render.mesh import MeshBuilder, Z, srgb
from chronoscene.synth.render.textures import DOOR, SIGN


@dataclass(frozen=True, slots=True)
class Front:
    """Styles and dimensions that all sides of a building share."""

    wall: int
    trim: int
    glass: int
    shop_glass: int
    sign: int
    door: int
    rail: int
    storey: float
    ground: float
    bay: float
    window: tuple[float, float]
    """Width and height."""
    cornice: float
    courses: bool

    @classmethod
    def random(
        cls,
        b: MeshBuilder,
        wall: str,
        rng: np.random.Generator,
        shape: np.random.Generator,
        storey: float,
        ground: float,
    ) -> Front:
        """Draw styles with ``rng`` and dimensions with ``shape``, so that another look of the same
        building keeps its geometry."""
        light = wall != "panel"
        frame = pal.pick(rng, (pal.WHITE, srgb(74, 54, 40), srgb(60, 64, 66), srgb(196, 190, 176)))
        panes = pal.pick(rng, ((2, 2), (2, 3), (2, 1), (1, 2)))
        wide = bool(shape.random() < 0.45)
        signs = pal.CLOTHS
        c_sign = pal.pick(rng, signs)
        trim = srgb(206, 198, 182) if light else srgb(96, 98, 100)
        return cls(
            wall=pal.wall_style(b, wall, rng, storey),
            trim=pal.plain_style(b, pal.tint(rng, trim), strength=0.2, size=0.8),
            glass=pal.glass_style(b, frame, panes),
            shop_glass=pal.glass_style(b, srgb(50, 52, 54), (3, 1)),
            sign=b.style(SIGN, c_sign, pal.WHITE, srgb(40, 40, 42)),
            door=b.style(DOOR, pal.tint(rng, srgb(92, 58, 38), 0.4), srgb(50, 58, 66), trim),
            rail=pal.metal_style(b, srgb(70, 74, 78)),
            storey=storey,
            ground=ground,
            bay=float(shape.uniform(3.0, 3.8) if wide else shape.uniform(2.3, 2.9)),
            window=(float(shape.uniform(1.7, 2.1)), 1.6) if wide else (1.15, 1.75),
            cornice=float(shape.uniform(0.2, 0.5)),
            courses=bool(shape.random() < 0.6),
        )


class Wall:
    """One side of a building.

    Args:
        b: Receives the geometry.
        front: Styles and dimensions of the building.
        corner: Lower left corner as seen from outside. [3]
        along: Unit vector along the wall. [3]
        width: Metres.
    """

    def __init__(
        self, b: MeshBuilder, front: Front, corner: Array, along: Array, width: float
    ) -> None:
        self.b, self.front = b, front
        self.corner, self.along, self.width = corner, along, width
        self.out = np.cross(along, Z)
        self.frame = (corner, along, Z)

    def at(self, x: Array | float, z: Array | float, depth: float = 0.0) -> Array:
        """World points of wall coordinates; ``depth`` goes into the wall. [N, 3]"""
        x, z = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(z))
        inside: Array = self.corner + x[:, None] * self.along + z[:, None] * Z
        return inside - depth * self.out

    def box(
        self, x: Array | float, z: float, style: int,
        *, w: float, h: float, depth: float, gap: float = 0.0,
    ) -> None:  # fmt: skip
        """Boxes that project from the wall by ``depth`` and end a ``gap`` before it."""
        corner = self.at(x, z, -depth)
        self.b.boxes(corner, w * self.along, -(depth - gap) * self.out, h * Z, style)

    def strip(self, z0: float, z1: float, *, depth: float) -> None:
        """A moulding along the whole wall, extended by its depth so that the corners close."""
        width = self.width + 2 * depth
        self.box(-depth, z0, self.front.trim, w=width, h=z1 - z0, depth=depth, gap=0.005)

    def add(
        self, storeys: int, rng: np.random.Generator, *, blank: bool, shop: bool, balconies: bool,
        simple: bool,
    ) -> None:  # fmt: skip
        """Add the wall with its openings.

        Args:
            storeys: Number of storeys.
            rng: Draws the door.
            blank: Whether this is a fire wall without openings.
            shop: Whether the ground floor has shop windows and signs.
            balconies: Whether upper storeys have balconies.
            simple: Whether windows are flat, for buildings in the distance.
        """
        front, b = self.front, self.b
        height = front.ground + front.storey * (storeys - 1)
        bays = max(1, int((self.width - 0.8) // front.bay))
        door = int(rng.integers(bays))
        blank = blank or self.width < 2.4
        if blank or simple:
            whole = self.width * self.along, height * Z
            b.quads(self.at(0, 0), *whole, front.wall, frame=self.frame)
        if blank:
            return
        pitch = self.width / bays
        centres = np.linspace(0.5 * pitch, self.width - 0.5 * pitch, bays)
        w, h = min(front.window[0], pitch - 0.7), front.window[1]
        left = centres - w / 2
        if simple:
            z = front.ground - front.storey + front.storey * np.arange(storeys) + 0.85
            xs, zs = (a.ravel() for a in np.meshgrid(left, z))
            b.quads(self.at(xs, zs, -0.06), w * self.along, h * Z, front.glass)
            return
        if shop:
            self._shops(centres, pitch, door)
        else:
            self._row(0.0, front.ground, left, front.glass, w=w, h=h, sill=1.1)
            self._sills(left, w, 1.1)
            self._door(centres[door] - 0.8)
        for level in range(1, storeys):
            z0 = front.ground + front.storey * (level - 1)
            self._row(z0, z0 + front.storey, left, front.glass, w=w, h=h, sill=0.85)
            self._sills(left, w, z0 + 0.85)
            if front.courses or level == 1:
                self.strip(z0 - 0.1, z0 + 0.12, depth=0.10)
            if balconies and bays >= 2:
                self._balconies(centres[(level + np.arange(bays)) % 2 == 0], z0)
        self.strip(height - 0.35, height, depth=front.cornice)

    def _row(
        self, z0: float, z1: float, xs: Array, glass: int, *, w: float, h: float, sill: float
    ) -> None:
        """Wall between two heights around equal windows whose left edges are at ``xs``."""
        b, front, u, n, recess = self.b, self.front, self.along, self.out, 0.18
        low, high = z0 + sill, z0 + sill + h
        b.quads(self.at(0, z0), self.width * u, sill * Z, front.wall, frame=self.frame)
        b.quads(self.at(0, high), self.width * u, (z1 - high) * Z, front.wall, frame=self.frame)
        starts, ends = np.concatenate([[0.0], xs + w]), np.concatenate([xs, [self.width]])
        piers = (ends - starts)[:, None] * u
        b.quads(self.at(starts, low), piers, h * Z, front.wall, frame=self.frame)
        b.quads(self.at(xs, low), w * u, -recess * n, front.trim)
        b.quads(self.at(xs, high, recess), w * u, recess * n, front.trim)
        b.quads(self.at(xs, low), -recess * n, h * Z, front.trim)
        b.quads(self.at(xs + w, low, recess), recess * n, h * Z, front.trim)
        b.quads(self.at(xs, low, recess), w * u, h * Z, glass, seed=int(z0 * 10))

    def _sills(self, xs: Array, w: float, z: float) -> None:
        """Sill boards below windows."""
        self.box(xs - 0.1, z - 0.1, self.front.trim, w=w + 0.2, h=0.1, depth=0.14, gap=0.01)

    def _door(self, x: float) -> None:
        """A house door with its frame, canopy and step."""
        trim = self.front.trim
        self.b.boxes(self.at(x, 0.0), 1.6 * self.along, -0.12 * self.out, 3.0 * Z, trim)
        self.box(x, 0.0, trim, w=1.6, h=3.05, depth=0.12)
        leaf = self.at(x + 0.2, 0.16, -0.14)
        self.b.quads(leaf, 1.2 * self.along, 2.6 * Z, self.front.door)
        self.box(x - 0.3, 3.05, trim, w=2.2, h=0.15, depth=0.8)
        self.box(x - 0.1, 0.0, trim, w=1.8, h=0.15, depth=0.9)

    def _shops(self, centres: Array, pitch: float, door: int) -> None:
        """Ground floor with shop windows, a door, signs and awnings."""
        b, front, u = self.b, self.front, self.along
        w = pitch - 0.6
        top = front.ground - 0.95
        left = centres - w / 2
        self._row(0.0, front.ground, left, front.shop_glass, w=w, h=top - 0.45, sill=0.45)
        b.quads(self.at(left, front.ground - 0.8, -0.08), w * u, 0.6 * Z, front.sign, seed=5)
        self.box(centres[door] - 0.6, 0.0, front.trim, w=1.2, h=2.5, depth=0.1)
        b.quads(self.at(centres[door] - 0.5, 0.05, -0.12), u, 2.35 * Z, front.door)
        slope = 1.3 * self.out - 0.5 * Z
        for i, x in enumerate(left):
            if i % 3 == 1:  # an awning that slopes away from the wall
                b.quads(self.at(x, top + 0.1), slope, w * u, front.sign, seed=i)
                b.quads(self.at(x, top + 0.04), w * u, slope, front.sign, seed=i + 50)

    def _balconies(self, centres: Array, z: float) -> None:
        """Slabs with barred railings in front of some windows."""
        w, depth = 2.1, 1.15
        b, rail, u, n = self.b, self.front.rail, self.along, self.out
        corner = self.at(centres - w / 2, z + 0.02, -depth)
        b.boxes(corner, w * u, -depth * n, 0.16 * Z, self.front.trim)
        b.boxes(corner + 0.95 * Z, w * u, -0.06 * n, 0.08 * Z, rail)
        for i in range(9):
            bar = corner + (i * (w - 0.05) / 8) * u + 0.16 * Z
            b.boxes(bar, 0.05 * u, -0.05 * n, 0.8 * Z, rail)
        for side in (0.0, w - 0.05):
            b.boxes(corner + side * u + 0.16 * Z, 0.05 * u, -(depth - 0.02) * n, 0.85 * Z, rail)
