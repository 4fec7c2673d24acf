"""Layout of the city: blocks and their roles, roads between them, surrounding countryside."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.city.blocks import FILLERS
from chronoscene.synth.city.buildings import Building, finished
from chronoscene.synth.city.ground import Rect
from chronoscene.synth.city.placing import PARKING, RING, Block, curb_side
from chronoscene.synth.city.vegetation import tree
from chronoscene.synth.city.world import World
from chronoscene.synth.render.light import make_lights
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, X, Y, srgb
from chronoscene.synth.render.noise import key_number, rng_for
from chronoscene.synth.render.textures import FIELDS
from chronoscene.synth.settings import SynthSettings

ROAD = 9.6  # Width of roads with parked cars on both sides, metres
FAR = 900.0  # Half the extent of the countryside, metres
REBUILT = ("houses", "slabs", "tower", "park")  # Roles of a block after it is torn down and rebuilt


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Grid of blocks; the outermost ring is suburban."""

    x: Array
    """West and east edge of each column. [N, 2]"""
    y: Array
    """South and north edge of each row. [N, 2]"""

    def rect(self, column: int, row: int) -> Rect:
        (x0, x1), (y0, y1) = self.x[column], self.y[row]
        return Rect(float(x0), float(y0), float(x1), float(y1))


def make_plan(settings: SynthSettings) -> Plan:
    """Edges of the blocks, centred on the origin."""
    rng = rng_for(settings.seed, "plan")
    edges = []
    for _ in range(2):
        sizes = settings.block_size * rng.uniform(0.88, 1.15, settings.blocks + 2)
        sizes[[0, -1]] = 40.0
        ends = np.cumsum(sizes + ROAD)
        low = ends - sizes - ROAD
        middle = (low[0] + ends[-1] - ROAD) / 2
        edges.append(np.stack([low, low + sizes], axis=1) - middle)
    return Plan(*edges)


def make_world(settings: SynthSettings) -> World:
    """Build the objects of all periods."""
    plan = make_plan(settings)
    n = settings.blocks
    core = np.array([[plan.x[1, 0], plan.y[1, 0]], [plan.x[n, 1], plan.y[n, 1]]])
    lights = make_lights(settings.seed, settings.periods, same=settings.same_light)
    world = World(settings.seed, lights, core)
    world.near = settings.kind == "street"
    _add_roads(world, plan)
    for (column, row), role in _roles(settings).items():
        name = f"block_{column}{row}"
        rect = plan.rect(column, row)
        _fill(world, settings, name, rect, role)
        if role != "suburb":
            curb_side(world, name, rect)
    _add_surroundings(world, plan)
    return world


def _fill(world: World, settings: SynthSettings, name: str, rect: Rect, role: str) -> None:
    """Fill a block, which may be torn down and rebuilt with another role at one period."""

    def build(role: str, name: str) -> None:
        FILLERS[role](Block.paved(world, name, rect, 2.0 if role == "suburb" else RING))

    rng = rng_for(settings.seed, name, "rebuilt")
    if world.periods == 1 or rng.random() >= settings.rebuilt:
        build(role, name)
        return
    date = int(rng.integers(1, world.periods))
    with world.during(range(date)):
        build(role, name)
    other = role if role == "suburb" else str(rng.choice(sorted({*REBUILT} - {role})))
    with world.during(range(date, world.periods)):
        build(other, f"{name}_rebuilt")


def _roles(settings: SynthSettings) -> dict[tuple[int, int], str]:
    """Role of each block; the core has one square, one building site and one renewal."""
    rng = rng_for(settings.seed, "roles")
    n = settings.blocks
    cells = list(product(range(1, n + 1), range(1, n + 1)))
    middle = (n + 1) / 2
    rng.shuffle(cells)
    cells.sort(key=lambda c: max(abs(c[0] - middle), abs(c[1] - middle)))
    wanted = ["square", "site", "renewal", "houses"]
    others = ["houses", "slabs", "houses", "park", "tower", "slabs"]
    rest = [others[k % len(others)] for k in range(len(cells) - len(wanted))]
    tail = wanted[1:] + rest
    rng.shuffle(tail)
    roles = dict(zip(cells, ["square", *tail], strict=True))
    for cell in product(range(n + 2), range(n + 2)):
        roles.setdefault(cell, "suburb")
    return roles


def _add_roads(world: World, plan: Plan) -> None:
    """Add the roads between blocks, with junctions and zebra crossings."""
    b = MeshBuilder(key_number("roads"))
    lanes, bare = pal.asphalt_style(b, 1, parking=PARKING), pal.asphalt_style(b, 0)
    zebra = pal.asphalt_style(b, 2)

    def add(axis: int, ends: Array, *, side: float, far: float, seed: int, core: bool) -> None:
        """Add the road beside a block, along x (axis 0) or y (1); only the core has crossings."""

        def at(s: float, t: float, z: float = 0.0) -> Array:
            return np.array([t, s, z] if axis else [s, t, z])

        low, high = ends
        along, across = (Y, (far - side) * X) if axis else (X, (far - side) * Y)
        b.quads(at(low, side), (high - low) * along, across, lanes, seed=seed)
        if core:
            for s in (low + 1.0, high - 4.0):
                b.quads(at(s, side, 0.012), 3.0 * along, across, zebra)
            middle = (side + far) / 2
            world.roads.append((at(low, middle)[:2], at(high, middle)[:2]))

    columns, rows = plan.x, plan.y
    between_columns = np.column_stack([columns[:-1, 1], columns[1:, 0]])
    between_rows = np.column_stack([rows[:-1, 1], rows[1:, 0]])
    for i, (x0, x1) in enumerate(between_columns):
        for j, ends in enumerate(rows):
            add(1, ends, side=x1, far=x0, seed=i, core=0 < j < len(rows) - 1)
        for j, (y0, y1) in enumerate(between_rows):
            b.quads([x0, y0, 0], (x1 - x0) * X, (y1 - y0) * Y, bare, seed=j)
    for j, (y0, y1) in enumerate(between_rows):
        for i, ends in enumerate(columns):
            add(0, ends, side=y0, far=y1, seed=j + 40, core=0 < i < len(columns) - 1)
    world.always("roads", "ground", b.build)


def _add_surroundings(world: World, plan: Plan) -> None:
    """Add hills with fields, and scattered farms and trees."""
    low, high = np.array([plan.x[0, 0], plan.y[0, 0]]), np.array([plan.x[-1, 1], plan.y[-1, 1]])
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
        name, Rect(at[0] - w / 2, at[1] - d / 2, at[0] + w / 2, at[1] + d / 2),
        storeys=int(rng.integers(1, 4)), roof=str(rng.choice(["gable", "hip"])),
        wall=str(rng.choice(["plaster", "brick"])), simple=True,
    )  # fmt: skip
    mesh = finished(spec, world.seed)
    mesh.vertices[..., 2] += np.float32(z - 0.8)
    mesh.patches[:, 2] += z - 0.8
    world.always(name, "building", lambda: mesh)


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


def _terrain(hills: _Hills) -> Mesh:
    """Terrain grid with smooth normals, finer near the city."""
    b = MeshBuilder(key_number("country"))
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
