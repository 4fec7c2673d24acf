"""Flat, gable and hip roofs, with dormers, chimneys and rooftop equipment."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.render.mesh import MeshBuilder, X, Y, Z, srgb
from chronoscene.synth.render.textures import SOLAR

EAVE = 0.45  # How far pitched roofs reach beyond the walls


def add_roof(
    b: MeshBuilder, kind: str, corner: Array, size: tuple[float, float], wall: int,
    rng: np.random.Generator, *, plain: bool,
) -> None:  # fmt: skip
    """Add a roof and the objects on it.

    Args:
        b: Receives the geometry.
        kind: ``flat``, or ``gable`` or ``hip`` with the ridge along the longer side.
        corner: Lowest corner of the roof. [3]
        size: Extent along x and y.
        wall: Style of parapets and gables.
        rng: Draws slope, colours and objects.
        plain: Whether to omit small objects.
    """
    if kind == "flat":
        _flat_roof(b, corner, size, wall, rng, plain)
        return
    dx, dy = size
    tiles, fascia = pal.roof_tile_style(b, rng), pal.wood_style(b, srgb(110, 84, 62))
    slope = float(rng.uniform(0.62, 0.9))
    if dx >= dy:
        o, a, c, length, depth = corner, X, Y, dx, dy
    else:
        o, a, c, length, depth = corner + dx * X, Y, -X, dy, dx
    roof = _PitchedRoof(
        b, o, a, c, length=length, depth=depth, slope=slope, tiles=tiles, fascia=fascia, wall=wall
    )
    if kind == "hip":
        roof.add_hip()
    else:
        roof.add_gable()
    if plain:
        return
    roof.add_chimneys(rng)
    if kind == "gable" and roof.length > 9:
        roof.add_dormers(rng)


def _flat_roof(
    b: MeshBuilder, corner: Array, size: tuple[float, float], wall: int,
    rng: np.random.Generator, plain: bool,
) -> None:  # fmt: skip
    """Parapet, surface, and rooftop equipment."""
    dx, dy = size
    roof = pal.flat_roof_style(b, rng)
    coping = pal.plain_style(b, srgb(170, 164, 154))
    h, t = float(rng.uniform(0.4, 0.9)), 0.3
    inner = corner + t * (X + Y) + 0.05 * Z
    b.quads(inner, (dx - 2 * t) * X, (dy - 2 * t) * Y, roof)
    rails = [
        (corner, dx * X, t * Y),
        (corner + (dy - t) * Y, dx * X, t * Y),
        (corner + t * Y, t * X, (dy - 2 * t) * Y),
        (corner + t * Y + (dx - t) * X, t * X, (dy - 2 * t) * Y),
    ]
    for o, along, across in rails:
        b.boxes(o, along, across, h * Z, wall, top=coping, bottom=False)
    if not plain and min(dx, dy) > 6:
        _roof_boxes(b, inner, dx - 2 * t, dy - 2 * t, rng)


def _roof_boxes(
    b: MeshBuilder, corner: Array, dx: float, dy: float, rng: np.random.Generator
) -> None:
    """Stair heads, ventilation and solar panels in the cells of a grid, so that none overlap."""
    metal = pal.metal_style(b, srgb(178, 180, 180), dust=0.3)
    house = pal.wall_style(b, "plaster", rng, 3.0)
    cover = pal.flat_roof_style(b, rng)
    solar = b.style(
        SOLAR, srgb(26, 34, 64), srgb(70, 82, 110), srgb(190, 192, 194), reflect=0.06, sharp=0.8
    )
    cols, rows = max(1, int(dx // 4.2)), max(1, int(dy // 4.2))
    cx, cy = dx / cols, dy / rows
    for i in range(cols):
        for j in range(rows):
            o = corner + (i * cx + 0.7) * X + (j * cy + 0.7) * Y
            w, d, kind = cx - 1.4, cy - 1.4, rng.random()
            if kind < 0.12:
                b.boxes(o, w * X, d * Y, 2.5 * Z, house, top=cover, bottom=False, seed=i + 9 * j)
            elif kind < 0.34:
                s = rng.uniform(0.8, 1.6, 3)
                b.boxes(o, min(w, s[0]) * X, min(d, s[1]) * Y, s[2] * Z, metal, seed=i + 9 * j)
                fan = pal.plain_style(b, srgb(52, 54, 56))
                b.boxes(o + 0.2 * (X + Y) + s[2] * Z, 0.5 * X, 0.5 * Y, 0.12 * Z, fan)
            elif kind < 0.56:
                up = 0.35 * d * Z
                b.quads(o + 0.25 * Z, w * X, d * Y + up, solar, seed=i + 9 * j)
                b.quads(o + 0.2 * Z, d * Y + up, w * X, metal, seed=i + 9 * j)
                b.quads(o + w * X + d * Y, -w * X, up + 0.2 * Z, metal)
            elif kind < 0.64:
                b.boxes(o, 0.5 * X, 0.5 * Y, 1.3 * Z, house, bottom=False)


@dataclass(frozen=True, slots=True, eq=False)
class _PitchedRoof:
    """Pitched roof with corner ``o``, axis ``a`` along the ridge and axis ``c`` across it."""

    b: MeshBuilder
    o: Array
    a: Array
    c: Array
    _: KW_ONLY
    length: float
    depth: float
    slope: float
    """Rise per horizontal metre."""
    tiles: int
    fascia: int
    wall: int

    @property
    def rise(self) -> float:
        """Height of the ridge."""
        return self.slope * self.depth / 2

    @property
    def drop(self) -> float:
        """Height of the corner above the eaves."""
        return self.slope * EAVE

    def add_gable(self) -> None:
        """Two slopes with thickness and two gable walls."""
        b, o, a, c, length, depth = self.b, self.o, self.a, self.c, self.length, self.depth
        over = 0.3
        ridge = self.rise * Z + depth / 2 * c
        low = o - over * a - EAVE * c - self.drop * Z
        span = (length + 2 * over) * a
        up = ridge + EAVE * c + self.drop * Z
        low2 = o + (length + over) * a + (depth + EAVE) * c - self.drop * Z
        up2 = ridge - depth * c - EAVE * c + self.drop * Z
        b.quads(low + 0.2 * Z, span, up, self.tiles)
        b.quads(low2 + 0.2 * Z, -span, up2, self.tiles, seed=3)
        for corner, s, u in ((low, span, up), (low2, -span, up2)):
            b.quads(corner, u, s, self.fascia)
            b.quads(corner, s, 0.2 * Z, self.fascia)
            b.quads(corner + s, u, 0.2 * Z, self.fascia)
            b.quads(corner + u, -u, 0.2 * Z, self.fascia)
        east, west = o + length * a, o + depth * c
        b.polygon([east, east + depth * c, east + ridge], self.wall, frame=(east, c, Z))
        b.polygon([west, o, o + ridge], self.wall, frame=(west, -c, Z))

    def add_hip(self) -> None:
        """Four slopes; the ridge is shorter than the house by the depth of the house."""
        b, o, a, c, length, depth = self.b, self.o, self.a, self.c, self.length, self.depth
        run = min(depth, length) / 2
        p = [
            o + x * a + y * c - self.drop * Z
            for x, y in (
                (-EAVE, -EAVE),
                (length + EAVE, -EAVE),
                (length + EAVE, depth + EAVE),
                (-EAVE, depth + EAVE),
            )
        ]
        r0, r1 = (o + x * a + depth / 2 * c + self.rise * Z for x in (run, length - run))
        lift = 0.02 * Z
        for i, top in enumerate(([r1, r0], [r1], [r0, r1], [r0])):
            first, second = p[i], p[(i + 1) % 4]
            u = (second - first) / np.linalg.norm(second - first)
            normal = np.cross(second - first, top[0] - first)
            v = np.cross(normal / np.linalg.norm(normal), u)
            corners = [first + lift, second + lift, *(t + lift for t in top)]
            b.polygon(corners, self.tiles, frame=(first, u, v), seed=i)
            b.quads(first - 0.16 * Z, second - first, 0.18 * Z, self.fascia)
        b.quads(p[0] - 0.16 * Z, p[3] - p[0], p[1] - p[0], self.fascia)

    def add_chimneys(self, rng: np.random.Generator) -> None:
        """One or two chimneys near the ridge."""
        brick = pal.wall_style(self.b, "brick", rng, 9.0)
        for f in rng.uniform(0.2, 0.8, int(rng.integers(1, 3))):
            side = float(rng.uniform(0.3, 0.42))
            at = self.o + f * self.length * self.a + side * self.depth * self.c
            at = at + (2 * side * self.rise - 0.5) * Z
            self.b.boxes(at, 0.7 * self.a, 0.5 * self.c, 2.1 * Z, brick, bottom=False)

    def add_dormers(self, rng: np.random.Generator) -> None:
        """Dormers with a window each in both slopes."""
        b, length, depth = self.b, self.length, self.depth
        glass = pal.glass_style(b, pal.WHITE)
        far = self.o + length * self.a + depth * self.c
        slopes = ((self.o, self.a, self.c), (far, -self.a, -self.c))
        for side, (start, axis, inwards) in enumerate(slopes):
            count = int(rng.integers(0, max(2, int(length // 5))))
            for i in range(count):
                x = (i + 0.5) * length / count
                at = start + (x - 0.75) * axis + 0.16 * depth * inwards
                base = at + (0.32 * self.rise - 0.1) * Z
                deep = 0.26 * depth
                b.boxes(base, 1.5 * axis, deep * inwards, 1.5 * Z, self.wall, bottom=False)
                window = base - 0.02 * inwards + 0.25 * axis + 0.35 * Z
                b.quads(window, axis, 1.0 * Z, glass, seed=i + 7 * side)
                roof = base + 1.5 * Z - 0.2 * axis - 0.25 * inwards
                b.boxes(roof, 1.9 * axis, (deep + 0.3) * inwards, 0.14 * Z, self.tiles)
