"""Walls with real openings: recessed windows, sills, cornices, shop fronts, balconies."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.synth.city import palettes as pal
from chronoscene.synth.render.mesh import PartBuilder, srgb
from chronoscene.synth.render.textures import DOOR, SIGN

Array = NDArray[np.float64]
Z = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, slots=True)
class Front:
    """Choices that all sides of one building share."""

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
        b: PartBuilder,
        wall: str,
        rng: np.random.Generator,
        shape: np.random.Generator,
        storey: float,
        ground: float,
    ) -> Front:
        """Draw colours from one generator and sizes from another: another look of the same
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
            trim=pal.plain_style(b, pal.tint(rng, trim), 0.2, 0.8),
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


@dataclass(frozen=True, slots=True, eq=False)
class _Wall:
    """One side: its corner, axes and texture frame."""

    corner: Array
    along: Array
    out: Array
    width: float

    def at(self, x: Array | float, z: Array | float, depth: float = 0.0) -> Array:
        """World points of wall coordinates. [N, 3]"""
        x, z = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(z))
        inside: Array = self.corner + x[:, None] * self.along + z[:, None] * Z
        return inside - depth * self.out

    @property
    def frame(self) -> tuple[Array, Array, Array]:
        return self.corner, self.along, Z


def facade(
    b: PartBuilder,
    front: Front,
    corner: Array,
    along: Array,
    width: float,
    storeys: int,
    *,
    blank: bool,
    shop: bool,
    balconies: bool,
    simple: bool,
    rng: np.random.Generator,
) -> None:
    """Add one side of a building.

    Args:
        b: Receives the geometry.
        front: Choices of the building.
        corner: Lower left corner seen from outside. [3]
        along: Unit vector along the wall. [3]
        width: Metres.
        storeys: Number of storeys.
        blank: A fire wall without openings.
        shop: Whether the ground floor has shop windows and signs.
        balconies: Whether upper storeys have balconies.
        simple: Windows without recess, for buildings in the distance.
        rng: Draws doors and balconies.
    """
    wall = _Wall(corner, along, np.cross(along, Z), width)
    height = front.ground + front.storey * (storeys - 1)
    bays = max(1, int((width - 0.8) // front.bay))
    door = int(rng.integers(bays))
    if blank or width < 2.4:
        b.quads(wall.at(0, 0), width * along, height * Z, front.wall, frame=wall.frame)
        return
    pitch = width / bays
    centres = np.linspace(0.5 * pitch, width - 0.5 * pitch, bays)
    if simple:
        b.quads(wall.at(0, 0), width * along, height * Z, front.wall, frame=wall.frame)
        _flat_windows(b, front, wall, centres, storeys, pitch)
        return
    if shop:
        _shop_row(b, front, wall, centres, pitch, door)
    else:
        _ground_row(b, front, wall, centres, pitch, door)
    for level in range(1, storeys):
        z = front.ground + front.storey * (level - 1)
        w, h = min(front.window[0], pitch - 0.7), front.window[1]
        _row(b, front, wall, z, z + front.storey, centres - w / 2, w, 0.85, h, front.glass)
        _sills(b, front, wall, centres - w / 2, w, z + 0.85)
        if front.courses or level == 1:
            _strip(b, front.trim, wall, z - 0.1, z + 0.12, 0.10)
        if balconies and bays >= 2:
            _balconies(b, front, wall, centres[(level + np.arange(bays)) % 2 == 0], z)
    _strip(b, front.trim, wall, height - 0.35, height, front.cornice)


def _row(
    b: PartBuilder,
    front: Front,
    wall: _Wall,
    z0: float,
    z1: float,
    xs: Array,
    w: float,
    sill: float,
    h: float,
    glass: int,
    recess: float = 0.18,
) -> None:
    """Wall between two heights around equal openings at ``xs``, and what fills them."""
    u, n = wall.along, wall.out
    low, high = z0 + sill, z0 + sill + h
    if sill > 0:
        b.quads(wall.at(0, z0), wall.width * u, sill * Z, front.wall, frame=wall.frame)
    b.quads(wall.at(0, high), wall.width * u, (z1 - high) * Z, front.wall, frame=wall.frame)
    starts, ends = np.concatenate([[0.0], xs + w]), np.concatenate([xs, [wall.width]])
    piers = (ends - starts)[:, None] * u
    b.quads(wall.at(starts, low), piers, h * Z, front.wall, frame=wall.frame)
    b.quads(wall.at(xs, low), w * u, -recess * n, front.trim)
    b.quads(wall.at(xs, high, recess), w * u, recess * n, front.trim)
    b.quads(wall.at(xs, low), -recess * n, h * Z, front.trim)
    b.quads(wall.at(xs + w, low, recess), recess * n, h * Z, front.trim)
    b.quads(wall.at(xs, low, recess), w * u, h * Z, glass, seed=int(z0 * 10))


def _ground_row(
    b: PartBuilder, front: Front, wall: _Wall, centres: Array, pitch: float, door: int
) -> None:
    """Ground floor of a dwelling: windows, and a door in front of one of them."""
    w = min(front.window[0], pitch - 0.7)
    _row(b, front, wall, 0.0, front.ground, centres - w / 2, w, 1.1, front.window[1], front.glass)
    _sills(b, front, wall, centres - w / 2, w, 1.1)
    x = centres[door] - 0.8
    b.boxes(wall.at(x, 0.0), 1.6 * wall.along, -0.12 * wall.out, 3.0 * Z, front.trim)
    _proud_box(b, wall, x, 0.0, 1.6, 3.05, 0.12, front.trim)
    b.quads(wall.at(x + 0.2, 0.16, -0.14), 1.2 * wall.along, 2.6 * Z, front.door)
    _proud_box(b, wall, x - 0.3, 3.05, 2.2, 0.15, 0.8, front.trim)
    _proud_box(b, wall, x - 0.1, 0.0, 1.8, 0.15, 0.9, front.trim)


def _shop_row(
    b: PartBuilder, front: Front, wall: _Wall, centres: Array, pitch: float, door: int
) -> None:
    """Ground floor with shop windows, a door, signs and awnings."""
    w = pitch - 0.6
    top = front.ground - 0.95
    _row(b, front, wall, 0.0, front.ground, centres - w / 2, w, 0.45, top - 0.45, front.shop_glass)
    corner = wall.at(centres - w / 2, front.ground - 0.8, -0.08)
    b.quads(corner, w * wall.along, 0.6 * Z, front.sign, seed=5)
    _proud_box(b, wall, centres[door] - 0.6, 0.0, 1.2, 2.5, 0.1, front.trim)
    b.quads(wall.at(centres[door] - 0.5, 0.05, -0.12), wall.along, 2.35 * Z, front.door)
    cloth = front.sign
    for i, x in enumerate(centres - w / 2):
        if i % 3 == 1:  # an awning that slopes away from the wall
            slope = 1.3 * wall.out - 0.5 * Z
            b.quads(wall.at(x, top + 0.1), slope, w * wall.along, cloth, seed=i)
            b.quads(wall.at(x, top + 0.04), w * wall.along, slope, cloth, seed=i + 50)


def _flat_windows(
    b: PartBuilder, front: Front, wall: _Wall, centres: Array, storeys: int, pitch: float
) -> None:
    w, h = min(front.window[0], pitch - 0.7), front.window[1]
    z = front.ground - front.storey + front.storey * np.arange(storeys) + 0.85
    xs, zs = (a.ravel() for a in np.meshgrid(centres - w / 2, z))
    b.quads(wall.at(xs, zs, -0.06), w * wall.along, h * Z, front.glass)


def _sills(b: PartBuilder, front: Front, wall: _Wall, xs: Array, w: float, z: float) -> None:
    """Sill boards below windows."""
    corner = wall.at(xs - 0.1, z - 0.1, -0.14)
    b.boxes(corner, (w + 0.2) * wall.along, -0.13 * wall.out, 0.1 * Z, front.trim)


def _strip(b: PartBuilder, style: int, wall: _Wall, z0: float, z1: float, depth: float) -> None:
    """A moulding along the whole wall; longer by its depth, so that corners close."""
    corner = wall.at(-depth, z0, -depth)
    length = wall.width + 2 * depth
    b.boxes(corner, length * wall.along, -(depth - 0.005) * wall.out, (z1 - z0) * Z, style)


def _proud_box(
    b: PartBuilder,
    wall: _Wall,
    x: float,
    z: float,
    w: float,
    h: float,
    depth: float,
    style: int,
) -> None:
    """A box in front of the wall."""
    b.boxes(wall.at(x, z, -depth), w * wall.along, -depth * wall.out, h * Z, style)


def _balconies(b: PartBuilder, front: Front, wall: _Wall, centres: Array, z: float) -> None:
    """Slabs with solid or barred railings in front of some windows."""
    if len(centres) == 0:
        return
    w, depth = 2.1, 1.15
    u, n = wall.along, wall.out
    corner = wall.at(centres - w / 2, z + 0.02, -depth)
    b.boxes(corner, w * u, -depth * n, 0.16 * Z, front.trim)
    b.boxes(corner + 0.95 * Z, w * u, -0.06 * n, 0.08 * Z, front.rail)
    for i in range(9):
        bar = corner + (i * (w - 0.05) / 8) * u + 0.16 * Z
        b.boxes(bar, 0.05 * u, -0.05 * n, 0.8 * Z, front.rail)
    for side in (0.0, w - 0.05):
        b.boxes(corner + side * u + 0.16 * Z, 0.05 * u, -(depth - 0.02) * n, 0.85 * Z, front.rail)
