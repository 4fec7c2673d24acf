"""Buildings: facades with openings, roofs, and the stages of a construction site."""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from itertools import pairwise

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.city.facades import Front, Wall
from chronoscene.synth.city.ground import SLAB, Rect
from chronoscene.synth.city.roofs import add_roof
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, X, Y, Z, srgb
from chronoscene.synth.render.noise import key_number, rng_for


@dataclass(frozen=True, slots=True)
class Building:
    """A rectangular building aligned with the world axes. Lengths are metres."""

    name: str
    rect: Rect
    _: KW_ONLY
    storeys: int
    roof: str
    """``flat``, ``gable`` or ``hip``."""
    wall: str
    """``plaster``, ``brick``, ``panel`` or ``concrete``."""
    blank: tuple[bool, bool, bool, bool] = (False, False, False, False)
    """Sides without openings: south, east, north, west."""
    shops: tuple[bool, bool, bool, bool] = (False, False, False, False)
    """Sides with shop fronts."""
    balconies: bool = False
    storey: float = 3.1
    ground: float = 3.6
    look: int = 0
    """Changes colours and windows without changing the volume."""
    simple: bool = False
    """Windows without relief, for buildings seen from afar."""

    @property
    def wall_height(self) -> float:
        return self.ground + self.storey * (self.storeys - 1)

    @property
    def sides(self) -> list[tuple[Array, Array, float]]:
        """Lower left corner seen from outside, direction along the wall, and width of each side."""
        r, (dx, dy) = self.rect, self.rect.size
        corners = np.array([(r.x0, r.y0), (r.x1, r.y0), (r.x1, r.y1), (r.x0, r.y1)])
        a, b, c, d = np.insert(corners, 2, SLAB, axis=1)
        return [(a, X, dx), (b, Y, dy), (c, -X, dx), (d, -Y, dy)]


def finished(spec: Building, seed: int) -> Mesh:
    """The finished building."""
    rng = rng_for(seed, spec.name, "look", spec.look)
    b = MeshBuilder(key_number(spec.name, spec.look))
    shape = rng_for(seed, spec.name, "shape")
    front = Front.random(b, spec.wall, rng, shape, spec.storey, spec.ground)
    for i, (corner, along, width) in enumerate(spec.sides):
        wall = Wall(b, front, corner, along, width)
        wall.add(
            spec.storeys, shape, blank=spec.blank[i], shop=spec.shops[i],
            balconies=spec.balconies and i % 2 == 0, simple=spec.simple,
        )  # fmt: skip
    # The roof keeps its own random numbers: a new look of the walls must not move its parts.
    roof_rng = rng_for(seed, spec.name, "roof")
    top = spec.rect.at(0, 0, SLAB + spec.wall_height)
    add_roof(b, spec.roof, top, spec.rect.size, front.wall, roof_rng, plain=spec.simple)
    return b.build()


def frame(spec: Building, storeys: int, seed: int) -> Mesh:
    """Concrete frame of the first storeys: slabs, columns, core, and a scaffold on one side."""
    b = MeshBuilder(key_number(spec.name, "frame"))
    rng = rng_for(seed, spec.name, "frame")
    concrete = pal.wall_style(b, "concrete", rng, spec.storey)
    r, (dx, dy) = spec.rect, spec.rect.size
    levels = SLAB + spec.ground + spec.storey * np.arange(-1, storeys)
    levels[0] = SLAB
    corners = np.stack([np.full(len(levels), r.x0), np.full(len(levels), r.y0), levels], 1)
    b.boxes(corners - 0.28 * Z * (levels > 1)[:, None], [dx, 0, 0], [0, dy, 0], 0.28 * Z, concrete)
    xs = np.linspace(r.x0 + 0.4, r.x1 - 0.8, max(3, round(dx / 5)))
    ys = np.linspace(r.y0 + 0.4, r.y1 - 0.8, max(3, round(dy / 5)))
    grid = np.stack(np.meshgrid(xs, ys, indexing="ij"), -1).reshape(-1, 2)
    for low, high in pairwise(levels):
        base = np.column_stack([grid, np.full(len(grid), low + 0.02)])
        b.boxes(base, [0.4, 0, 0], [0, 0.4, 0], (high - low - 0.32) * Z, concrete)
    core = [r.x0 + 0.42 * dx, r.y0 + 0.38 * dy, SLAB + 0.3]
    b.boxes(core, [0.2 * dx, 0, 0], [0, 0.25 * dy, 0], (levels[-1] + 1.6) * Z, concrete)
    _rods(b, spec, grid, float(levels[-1]))
    _scaffold(b, spec, float(levels[-1]))
    return b.build()


def _rods(b: MeshBuilder, spec: Building, grid: Array, top: float) -> None:
    """Starter bars for the next storey, and pallets on the top slab."""
    r, steel = spec.rect, pal.plain_style(b, srgb(122, 78, 52))
    base = np.column_stack([grid + 0.1, np.full(len(grid), top)])
    b.boxes(base, [0.16, 0, 0], [0, 0.16, 0], 1.1 * Z, steel)
    rng = rng_for(key_number(spec.name), "pallets")
    wood = pal.wood_style(b, srgb(176, 138, 90))
    n = 7
    x = rng.uniform(r.x0 + 1, r.x1 - 3, n)
    y = rng.uniform(r.y0 + 1, r.y1 - 3, n)
    size = rng.uniform(0.7, 1.6, (n, 3))
    base = np.column_stack([x, y, np.full(n, top)])
    b.boxes(base, size[:, :1] * X, size[:, 1:2] * Y, size[:, 2:] * Z, wood, bottom=False)


def _scaffold(b: MeshBuilder, spec: Building, top: float) -> None:
    """Poles and boards along the south side."""
    r, pole = spec.rect, pal.metal_style(b, srgb(176, 150, 60))
    board = pal.wood_style(b, srgb(184, 150, 100))
    xs = np.arange(r.x0, r.x1 - 0.1, 2.5)
    for y in (r.y0 - 1.5, r.y0 - 0.5):
        base = np.column_stack([xs, np.full(len(xs), y), np.full(len(xs), SLAB)])
        b.boxes(base, [0.14, 0, 0], [0, 0.14, 0], (top - SLAB) * Z, pole)
    zs = np.arange(SLAB + 2.0, top, 2.1)
    base = np.column_stack([np.full(len(zs), r.x0), np.full(len(zs), r.y0 - 1.4), zs])
    b.boxes(base, [r.x1 - r.x0, 0, 0], [0, 0.9, 0], 0.08 * Z, board)


def foundation(spec: Building, seed: int) -> Mesh:
    """Ground slab with starter walls and stacks of material."""
    b = MeshBuilder(key_number(spec.name, "foundation"))
    rng = rng_for(seed, spec.name, "foundation")
    concrete = pal.wall_style(b, "concrete", rng, spec.storey)
    r, (dx, dy) = spec.rect, spec.rect.size
    b.boxes([r.x0, r.y0, SLAB], [dx, 0, 0], [0, dy, 0], 0.5 * Z, concrete, bottom=False)
    for f in (0.0, 0.33, 0.66):
        low = [r.x0 + f * dx, r.y0 + 0.5, SLAB + 0.5]
        b.boxes(low, [0.3, 0, 0], [0, dy - 1.0, 0], (0.8 + f) * Z, concrete, bottom=False)
    _rods(b, spec, np.array([[r.x0 + 1.5, r.y0 + 1.5]]), SLAB + 0.5)
    return b.build()


def rubble(spec: Building, seed: int) -> Mesh:
    """Heaps of debris and a stump of wall, left by a demolition."""
    b = MeshBuilder(key_number(spec.name, "rubble"))
    rng = rng_for(seed, spec.name, "rubble")
    n = 160
    r = spec.rect
    center, half = np.array(r.center), np.array(r.size) / 2
    place = rng.uniform(-0.85, 0.85, (n, 2))
    height = 1.9 * np.exp(-3.0 * (place**2).sum(1)) * rng.uniform(0.2, 1.0, n)
    for kind in range(3):
        mine = np.arange(n) % 3 == kind
        c = (srgb(160, 120, 96), srgb(168, 164, 156), srgb(120, 88, 70))[kind]
        turn = rng.uniform(0, 2 * np.pi, int(mine.sum()))
        size = rng.uniform(0.35, 1.5, (int(mine.sum()), 3)) * [1, 0.7, 0.5]
        a = np.column_stack([np.cos(turn), np.sin(turn), rng.normal(0, 0.25, len(turn))])
        a /= np.linalg.norm(a, axis=1, keepdims=True)
        side = np.cross(Z, a)
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        up = np.cross(a, side)
        at = np.column_stack([center + place[mine] * half, SLAB + height[mine]])
        style = pal.plain_style(b, c, strength=0.4, size=0.4)
        b.boxes(at, a * size[:, :1], side * size[:, 1:2], up * size[:, 2:], style)
    wall = pal.wall_style(b, "brick", rng, spec.storey)
    low = [r.x0, r.y0, SLAB]
    b.boxes(low, [0.4, 0, 0], [0, 0.6 * 2 * half[1], 0], 1.4 * Z, wall, bottom=False)
    return b.build()
