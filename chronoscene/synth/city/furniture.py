"""Small objects: vehicles, street furniture and site equipment."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.city.vegetation import trunk
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, Z, srgb
from chronoscene.synth.render.noise import key_number, rng_for
from chronoscene.synth.render.textures import CORRUGATED, PAINT, SIGN, WATER

Triple = tuple[float, float, float]


class Placed(MeshBuilder):
    """A builder with local axes: shapes are given in local metres and rotated into the world.

    Args:
        name: Name of the object.
        base: World point of the local origin. [3]
        turn: Angle from the world's x axis to the local one, in radians.
    """

    def __init__(self, name: str, base: Array, turn: float) -> None:
        super().__init__(key_number(name))
        self.base = np.asarray(base, np.float64)
        self.turn(turn)

    def turn(self, angle: float) -> None:
        """Set the direction of the local x axis."""
        self.x = np.array([np.cos(angle), np.sin(angle), 0.0])
        self.y = np.array([-np.sin(angle), np.cos(angle), 0.0])

    def at(self, x: float, y: float, z: float) -> Array:
        """World point of local coordinates. [3]"""
        return self.base + x * self.x + y * self.y + z * Z

    def box(
        self, low: Triple, size: Triple, style: int, *, top: int | None = None, seed: int = 0
    ) -> None:
        """A box from its lowest corner."""
        a, b, c = size[0] * self.x, size[1] * self.y, size[2] * Z
        self.boxes(self.at(*low), a, b, c, style, top=top, seed=seed)

    def prism(
        self, profile: list[tuple[float, float]], y0: float, y1: float, styles: list[int], side: int
    ) -> None:
        """A convex profile (x, z), counter-clockwise seen from -y, extruded along y."""
        near = [self.at(x, y0, z) for x, z in profile]
        far = [self.at(x, y1, z) for x, z in profile]
        self.polygon(near, side)
        self.polygon(far[::-1], side, seed=1)
        for i, style in enumerate(styles):
            j = (i + 1) % len(profile)
            self.polygon([near[j], near[i], far[i], far[j]], style, seed=2 + i)


def car(name: str, base: Array, turn: float, seed: int) -> Mesh:
    """A car or a van with wheels, windows and lights; the name determines type and colour."""
    rng = rng_for(seed, name, "car")
    p = Placed(name, base, turn)
    color = pal.pick(rng, pal.CARS)
    paint = pal.metal_style(p, pal.tint(rng, color), dust=0.08)
    glass = p.style(PAINT, srgb(24, 28, 34), reflect=0.14, sharp=0.9)
    rubber = pal.plain_style(p, srgb(28, 28, 30))
    lamp = pal.plain_style(p, srgb(240, 236, 220))
    red = pal.plain_style(p, srgb(160, 20, 20))
    van = rng.random() < 0.2
    length, width = (5.2, 1.95) if van else (float(rng.uniform(3.9, 4.6)), 1.75)
    h, w = length / 2, width / 2
    body = [(-h, 0.28), (h, 0.28), (h, 0.62), (h - 0.9, 0.86), (-h + 0.15, 0.92), (-h, 0.8)]
    p.prism(body, -w, w, [rubber, paint, paint, paint, paint, paint], paint)
    if van:
        roof, front, back = 2.05, h - 1.5, -h + 0.12
        cabin = [(back, 0.9), (h - 0.95, 0.86), (front, roof), (back, roof)]
    else:
        roof = float(rng.uniform(1.4, 1.55))
        cabin = [(-h + 0.35, 0.9), (h - 1.0, 0.86), (0.25, roof), (-h + 0.95, roof)]
    inset = 0.1
    p.prism(cabin, -w + inset, w - inset, [paint, glass, paint, glass], paint if van else glass)
    if van:
        p.box((h - 1.9, -w + inset - 0.01, 1.15), (0.8, width - 2 * inset + 0.02, 0.6), glass)
    for x in (-h + 0.75, h - 0.8):
        for y in (-w, w - 0.2):
            _wheel(p, x, y, rubber)
    for y in (-w + 0.12, w - 0.5):
        p.box((h - 0.06, y, 0.5), (0.08, 0.38, 0.14), lamp)
        p.box((-h - 0.02, y, 0.6), (0.08, 0.38, 0.16), red)
    return p.build()


def _wheel(p: Placed, x: float, y: float, style: int) -> None:
    turn = np.linspace(0, 2 * np.pi, 11)[:-1]
    profile = [(x + 0.32 * float(np.cos(t)), 0.32 + 0.32 * float(np.sin(t))) for t in turn]
    p.prism(profile, y - 0.01, y + 0.21, [style] * len(profile), style)


def bench(name: str, base: Array, turn: float) -> Mesh:
    """Wooden bench."""
    p = Placed(name, base, turn)
    wood = pal.wood_style(p, srgb(150, 104, 62), 0.11)
    iron = pal.plain_style(p, srgb(52, 54, 56))
    p.box((-0.9, -0.25, 0.42), (1.8, 0.5, 0.07), wood)
    p.box((-0.9, 0.22, 0.5), (1.8, 0.07, 0.45), wood)
    for x in (-0.75, 0.65):
        p.box((x, -0.2, 0.0), (0.1, 0.45, 0.42), iron)
    return p.build()


def lamp(name: str, base: Array, turn: float) -> Mesh:
    """Street lamp with an arm."""
    p = Placed(name, base, turn)
    iron = pal.metal_style(p, srgb(66, 74, 72))
    light = pal.plain_style(p, srgb(230, 228, 210), strength=0.05)
    trunk(p, p.base, p.at(0, 0, 6.2), 0.11, iron)
    p.box((-0.06, -0.06, 6.1), (1.6, 0.12, 0.12), iron)
    p.box((0.9, -0.16, 5.98), (0.75, 0.32, 0.14), light, top=iron)
    p.box((-0.2, -0.2, 0.0), (0.4, 0.4, 0.5), iron)
    return p.build()


def kiosk(name: str, base: Array, turn: float, seed: int) -> Mesh:
    """Kiosk with a sign, a counter and an awning."""
    rng = rng_for(seed, name, "kiosk")
    p = Placed(name, base, turn)
    color = pal.pick(rng, pal.CLOTHS)
    wall = pal.wood_style(p, pal.tint(rng, pal.pick(rng, pal.PLASTERS)), 0.3)
    roof = pal.metal_style(p, color)
    sign = p.style(SIGN, color, pal.WHITE, srgb(40, 40, 42))
    glass = pal.glass_style(p, pal.WHITE, (3, 1))
    p.box((-1.7, -1.2, 0.0), (3.4, 2.4, 2.5), wall)
    p.box((-2.0, -1.5, 2.5), (4.0, 3.0, 0.18), roof)
    p.quads(p.at(-1.4, -1.24, 1.0), 2.8 * p.x, 1.1 * Z, glass)
    p.quads(p.at(-1.5, -1.52, 2.7), 3.0 * p.x, 0.7 * Z, sign)
    p.quads(p.at(1.5, -1.5, 2.7), -3.0 * p.x, 0.7 * Z, roof)
    p.box((-1.5, -1.7, 0.9), (3.0, 0.5, 0.08), roof)
    return p.build()


def stall(name: str, base: Array, turn: float, seed: int) -> Mesh:
    """Market stall: a table with goods under a tent roof."""
    rng = rng_for(seed, name, "stall")
    p = Placed(name, base, turn)
    cloth = p.style(CORRUGATED, pal.pick(rng, pal.CLOTHS), pal.WHITE, None, (0.8, 0.0, 0.0))
    wood = pal.wood_style(p, srgb(156, 118, 76))
    for x in (-1.5, 1.42):
        for y in (-1.1, 1.02):
            p.box((x, y, 0.0), (0.08, 0.08, 2.2), wood)
    p.box((-1.4, -1.0, 0.0), (2.8, 1.3, 0.85), wood)
    for i in range(6):
        fruit = pal.plain_style(p, pal.pick(rng, pal.CLOTHS), strength=0.5, size=0.15)
        p.box((-1.35 + 0.46 * i, -0.95, 0.86), (0.4, 1.1, 0.16), fruit)
    ridge = [(-1.4, 2.15), (1.4, 2.15), (0.0, 2.95)]
    p.turn(turn + np.pi / 2)
    p.prism(ridge, -1.7, 1.7, [cloth, cloth, cloth], cloth)
    return p.build()


def container(name: str, base: Array, turn: float, seed: int) -> Mesh:
    """Shipping container or site office."""
    rng = rng_for(seed, name, "container")
    p = Placed(name, base, turn)
    color = pal.tint(rng, pal.pick(rng, (*pal.CLOTHS, srgb(70, 110, 80), srgb(120, 60, 40))))
    sheet = pal.sheet_style(p, color, rust=0.3, band=True)
    p.box((-3.0, -1.22, 0.1), (6.0, 2.44, 2.5), sheet)
    return p.build()


def fence(name: str, points: list[tuple[float, float]], z: float) -> Mesh:
    """Site fence along a path: posts and boards."""
    b = MeshBuilder(key_number(name))
    post = pal.plain_style(b, srgb(120, 120, 118))
    board = pal.sheet_style(b, srgb(196, 198, 194), rust=0.25, band=False)
    for (x0, y0), (x1, y1) in pairwise(points):
        start, along = np.array([x0, y0, z]), np.array([x1 - x0, y1 - y0, 0.0])
        length = float(np.linalg.norm(along))
        u = along / length
        side = np.cross(Z, u)
        b.boxes(start + 0.15 * Z, along, 0.06 * side, 1.8 * Z, board)
        steps = np.arange(0, length + 0.1, 3.0)
        b.boxes(start + steps[:, None] * u - 0.06 * side, 0.12 * u, 0.18 * side, 2.0 * Z, post)
    return b.build()


def crane(name: str, base: Array, turn: float, height: float) -> Mesh:
    """Tower crane with lattice mast and jib."""
    p = Placed(name, base, turn)
    yellow = pal.metal_style(p, srgb(222, 172, 30), dust=0.1)
    grey = pal.plain_style(p, srgb(150, 148, 142))
    cabin = pal.glass_style(p, srgb(200, 160, 30), (2, 1))
    p.box((-1.8, -1.8, 0.0), (3.6, 3.6, 0.8), grey)
    _lattice(p, np.array([-0.7, -0.7, 0.8]), np.array([0, 0, height - 0.8]), 1.4, yellow)
    p.box((-0.9, -0.9, height), (1.8, 1.8, 0.4), yellow)
    p.box((0.9, -0.8, height - 1.6), (1.2, 1.6, 1.7), cabin)
    reach = 0.85 * height
    _lattice(p, np.array([0.9, -0.6, height + 0.4]), np.array([reach, 0, 0]), 1.2, yellow)
    _lattice(p, np.array([-0.9, -0.6, height + 0.4]), np.array([-0.35 * reach, 0, 0]), 1.2, yellow)
    p.box((-0.35 * reach - 0.8, -0.9, height - 1.2), (2.2, 1.8, 1.6), grey)
    p.box((0.6 * reach, -0.04, 0.5 * height), (0.09, 0.09, 0.5 * height + 0.4), grey)
    p.box((0.6 * reach - 0.9, -0.7, 0.5 * height - 0.5), (1.8, 1.4, 0.5), grey)
    return p.build()


def _lattice(p: Placed, low: Array, way: Array, wide: float, style: int) -> None:
    """Four chords joined by rungs and diagonals; ``way`` points along one local axis."""
    axis = int(np.argmax(np.abs(way)))
    length, sign = abs(float(way[axis])), np.sign(way[axis])
    world = np.stack([p.x, p.y, Z])
    along = world[axis]
    s, t = world[(axis + 1) % 3], world[(axis + 2) % 3]
    start = p.at(*low) - (length * along if sign < 0 else 0)
    bar = 0.16
    for i, j in ((0, 0), (1, 0), (0, 1), (1, 1)):
        o = start + i * (wide - bar) * s + j * (wide - bar) * t
        p.boxes(o, bar * s, bar * t, length * along, style)
    steps = np.arange(0, length - wide, wide)[:, None] * along
    thin = 0.11
    for u, w in ((s, t), (t, s)):
        for far in (0.0, wide - thin):
            o = start + far * w + steps
            diagonal = (wide - thin) * u + wide * along
            p.boxes(o, thin * along, thin * w, diagonal, style)
            p.boxes(o, wide * u, thin * w, thin * along, style)


def fountain(name: str, base: Array, radius: float) -> Mesh:
    """Round basin with a column."""
    p = Placed(name, base, 0.0)
    stone = pal.plain_style(p, srgb(176, 168, 152), strength=0.35, size=0.5)
    water = p.style(WATER, srgb(60, 96, 110), srgb(96, 130, 140), reflect=0.1, sharp=0.6)
    turn = np.linspace(0, 2 * np.pi, 25)
    ring = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(25)])
    for i in range(24):
        u, v = ring[i], ring[i + 1]
        outer, inner = base + radius * u, base + (radius - 0.35) * u
        outer2, inner2 = base + radius * v, base + (radius - 0.35) * v
        top = 0.55 * Z
        p.polygon([outer, outer2, outer2 + top, outer + top], stone, seed=i)
        p.polygon([inner2, inner, inner + top, inner2 + top], stone, seed=i)
        p.polygon([outer + top, outer2 + top, inner2 + top, inner + top], stone, seed=i)
        p.polygon([base + 0.35 * Z, inner + 0.35 * Z, inner2 + 0.35 * Z], water)
    trunk(p, p.base, p.at(0, 0, 2.4), 0.4, stone)
    trunk(p, p.at(0, 0, 1.5), p.at(0, 0, 1.75), 1.1, stone)
    return p.build()


def statue(name: str, base: Array) -> Mesh:
    """Stepped plinth with an obelisk."""
    p = Placed(name, base, 0.3)
    stone = pal.plain_style(p, srgb(164, 156, 140), strength=0.35, size=0.5)
    bronze = pal.plain_style(p, srgb(88, 110, 92), strength=0.4, size=0.3)
    for i in range(3):
        r = 2.6 - 0.6 * i
        p.box((-r, -r, 0.25 * i), (2 * r, 2 * r, 0.26), stone, seed=i)
    p.box((-0.8, -0.8, 0.75), (1.6, 1.6, 1.9), stone, seed=4)
    trunk(p, p.at(0, 0, 2.65), p.at(0, 0, 6.4), 0.55, bronze)
    return p.build()


def digger(name: str, base: Array, turn: float) -> Mesh:
    """Excavator."""
    p = Placed(name, base, turn)
    yellow = pal.metal_style(p, srgb(224, 160, 30), dust=0.3)
    dark = pal.plain_style(p, srgb(44, 44, 46))
    glass = pal.glass_style(p, srgb(60, 60, 60), (2, 1))
    p.box((-1.8, -1.4, 0.0), (3.6, 0.6, 0.8), dark)
    p.box((-1.8, 0.8, 0.0), (3.6, 0.6, 0.8), dark)
    p.box((-1.9, -1.2, 0.9), (3.2, 2.4, 1.2), yellow)
    p.box((-0.2, 0.2, 2.1), (1.3, 1.0, 1.2), glass, top=yellow)
    a = p.at(1.2, -0.3, 1.6)
    p.boxes(a, 0.5 * p.x - 0.3 * Z, 0.5 * p.y, 2.4 * p.x + 2.0 * Z, yellow)
    elbow = p.at(3.7, -0.3, 3.6)
    p.boxes(elbow, 0.4 * p.x + 0.2 * Z, 0.5 * p.y, -0.6 * p.x + 0.4 * Z, yellow)
    p.boxes(p.at(4.4, -0.2, 0.9), 0.35 * p.x, 0.4 * p.y, -0.4 * p.x + 2.8 * Z, yellow)
    p.box((4.0, -0.6, 0.3), (0.9, 1.1, 0.8), dark)
    return p.build()
