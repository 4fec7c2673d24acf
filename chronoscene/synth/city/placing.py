"""What stands on a block: its ground, and cars, lamps, trees, benches and houses in place."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from chronoscene.synth.city import furniture as fur
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.city.buildings import SLAB, Building, finished
from chronoscene.synth.city.ground import PARKING, pavement
from chronoscene.synth.city.vegetation import hedge, tree
from chronoscene.synth.city.world import World, looks, tree_heights
from chronoscene.synth.render.mesh import Part, PartBuilder, srgb
from chronoscene.synth.render.noise import key_number, rng_for
from chronoscene.synth.render.textures import PAVING

Array = NDArray[np.float64]
X, Y, Z = np.eye(3)
RING = 3.0
"""Width of pavements, metres."""


@dataclass(frozen=True, slots=True)
class Rect:
    """Axis-aligned rectangle in metres."""

    x0: float
    y0: float
    x1: float
    y1: float

    def inset(self, d: float) -> Rect:
        return Rect(self.x0 + d, self.y0 + d, self.x1 - d, self.y1 - d)

    @property
    def size(self) -> tuple[float, float]:
        return self.x1 - self.x0, self.y1 - self.y0

    @property
    def center(self) -> tuple[float, float]:
        return (self.x0 + self.x1) / 2, (self.y0 + self.y1) / 2

    def at(self, fx: float, fy: float, z: float = SLAB) -> Array:
        """Point at fractions of the extents. [3]"""
        dx, dy = self.size
        return np.array([self.x0 + fx * dx, self.y0 + fy * dy, z])


def paved_block(world: World, name: str, rect: Rect, ring: float = RING) -> Rect:
    low, high = np.array([rect.x0, rect.y0]), np.array([rect.x1, rect.y1])
    world.always(f"{name}/pavement", "ground", lambda: pavement(name, low, high, ring, world.seed))
    return rect.inset(ring)


def floor(name: str, rect: Rect, surface: str, z: float = SLAB) -> Part:
    """One rectangle of ground: ``lawn SEASON``, ``soil``, ``car_park``, ``slabs``, ``rings``."""
    b = PartBuilder(key_number(name, "floor"))
    kind, _, season = surface.partition(" ")
    dx, dy = rect.size
    if kind == "lawn":
        style = pal.grass_style(b, season, 0.22)
    elif kind == "mown":
        style = pal.grass_style(b, season, 0.10, 0.22)
    elif kind == "soil":
        style = pal.soil_style(b, 0.10, 0.8)
    elif kind == "car_park":
        style = pal.asphalt_style(b, 3)
    elif kind == "rings":
        style = b.style(
            PAVING, srgb(184, 160, 132), srgb(132, 92, 74), srgb(96, 84, 72),
            (0.8, 0.8, 0.5, 2.0, 4.4),
        )  # fmt: skip
    elif kind == "bands":
        style = b.style(
            PAVING, srgb(176, 168, 154), srgb(118, 112, 108), srgb(84, 80, 76),
            (0.6, 0.6, 0.0, 1.0, 4.8),
        )  # fmt: skip
    else:
        style = b.style(
            PAVING, srgb(168, 150, 128), srgb(150, 140, 128), srgb(92, 84, 74),
            (0.4, 0.2, 0.5, 0.0, 1.0),
        )  # fmt: skip
    b.quads([rect.x0, rect.y0, z], dx * X, dy * Y, style)
    return b.build()


def lawn(world: World, name: str, rect: Rect, kind: str = "lawn", z: float = SLAB) -> None:
    states = [f"{kind} {season}" for season in world.seasons]
    world.add(f"{name}/lawn", "lawn", states, lambda s: floor(name, rect, s, z))


def path(world: World, name: str, points: Array, width: float) -> None:
    """Gravel path along a curve, a hand above the lawn's surface."""
    way = np.gradient(points, axis=0)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    side = np.column_stack([-way[:, 1], way[:, 0]]) * width / 2

    def make() -> Part:
        b = PartBuilder(key_number(name))
        style = pal.soil_style(b, 0.05, 0.0)
        left = np.column_stack([points + side, np.full(len(points), SLAB + 0.02)])
        right = np.column_stack([points - side, np.full(len(points), SLAB + 0.02)])
        frame = (np.zeros(3), X, Y)
        for i in range(len(points) - 1):
            b.polygon([right[i], right[i + 1], left[i + 1], left[i]], style, frame=frame)
        return b.build()

    world.always(name, "ground", make)


def plant(
    world: World,
    name: str,
    at: Array,
    rng: np.random.Generator,
    size: float = 6.5,
    broad: bool = False,
) -> None:
    """A tree that grows and changes with the seasons."""
    heights = tree_heights(rng, world.periods, float(rng.uniform(0.75, 1.25) * size))
    states = [
        None if h is None else (h, season) for h, season in zip(heights, world.seasons, strict=True)
    ]
    world.add(name, "tree", states, partial(tree, name, at, world.seed, 2, broad))


def plant_hedge(world: World, name: str, low: Array, high: Array) -> None:
    world.add(name, "tree", world.seasons, partial(hedge, name, low, high, world.seed))


def park_cars(
    world: World, name: str, places: list[tuple[float, float, float, float]], chance: float
) -> None:
    """Parked cars: each place (x, y, z, heading) holds one car, another or none per period."""
    rng = rng_for(world.seed, name, "cars")
    for i, (x, y, z, turn) in enumerate(places):
        stay = rng.random() < 0.2
        here = rng.random(world.periods) < chance
        heading = turn + rng.normal(0, 0.03) + (np.pi if rng.random() < 0.3 else 0)
        base = np.array([x, y, z])
        every = range(world.periods)
        groups = [list(every)] if stay else [[p] for p in every]
        for k, group in enumerate(groups):
            label = f"{name}/car_{i}_{k}"
            present = [p in group and bool(here[group[0]]) for p in every]
            world.place(label, "car", present, partial(fur.car, label, base, heading, world.seed))


def _lamps(world: World, name: str, rect: Rect) -> None:
    """Lamps along the kerb, arms over the road."""
    r = rect.inset(0.8)
    dx, dy = r.size
    spots = [(f, 0.0, -np.pi / 2) for f in np.linspace(0.2, 0.8, max(1, int(dx // 18)))]
    spots += [(f, 1.0, np.pi / 2) for f in np.linspace(0.2, 0.8, max(1, int(dx // 18)))]
    spots += [(0.0, f, np.pi) for f in np.linspace(0.3, 0.7, max(1, int(dy // 22)))]
    spots += [(1.0, f, 0.0) for f in np.linspace(0.3, 0.7, max(1, int(dy // 22)))]
    for i, (fx, fy, turn) in enumerate(spots):
        label, at = f"{name}/lamp_{i}", r.at(fx, fy)
        world.always(label, "lamp", partial(fur.lamp, label, at, turn))


def curb_side(world: World, name: str, rect: Rect, road: float) -> None:
    """Cars in the parking lanes around a block, and lamps."""
    places = []
    off = PARKING / 2
    step = 5.5
    for k in range(int((rect.size[0] - 10) // step)):
        x = rect.x0 + 8.0 + k * step
        places += [(x, rect.y0 - off, 0.0, 0.0), (x, rect.y1 + off, 0.0, np.pi)]
    for k in range(int((rect.size[1] - 10) // step)):
        y = rect.y0 + 8.0 + k * step
        places += [(rect.x0 - off, y, 0.0, np.pi / 2), (rect.x1 + off, y, 0.0, -np.pi / 2)]
    park_cars(world, name, places, 0.3 if world.near else 0.42)
    _lamps(world, name, rect)
    _avenue(world, name, rect)


def _avenue(world: World, name: str, rect: Rect) -> None:
    """Street trees in pits along some sides of a block."""
    rng = rng_for(world.seed, name, "avenue")
    r = rect.inset(1.0)
    ends = [r.at(0, 0), r.at(1, 0), r.at(1, 1), r.at(0, 1), r.at(0, 0)]
    for side, (a, b) in enumerate(pairwise(ends)):
        if rng.random() < 0.45:
            continue
        length = float(np.linalg.norm(b - a))
        for i in range(int((length - 10) // 9.5)):
            at = a + (8.0 + 9.5 * i + rng.uniform(-0.5, 0.5)) / length * (b - a)
            label = f"{name}/avenue_{side}{i}"
            pit = Rect(at[0] - 0.6, at[1] - 0.6, at[0] + 0.6, at[1] + 0.6)
            world.always(f"{label}/pit", "ground",
                         partial(floor, label, pit, "soil", SLAB + 0.015))  # fmt: skip
            plant(world, label, at, rng, 5.6, broad=True)


def put_house(
    world: World, spec: Building, *, chance: float = 0.3, also: tuple[str, ...] = ()
) -> None:
    """A finished building, which may get another facade."""
    rng = rng_for(world.seed, spec.name, "reclad")
    states = looks(rng, world.periods, chance)
    walls = (spec.wall, str(rng.choice(["plaster", "panel", "brick"])))
    world.add(
        spec.name,
        "facade",
        [(walls[s], s) for s in states],
        lambda s: finished(replace(spec, wall=s[0], look=s[1]), world.seed),
    )


def scatter_trees(
    world: World,
    name: str,
    rect: Rect,
    rng: np.random.Generator,
    count: int,
    avoid: Array | None = None,
) -> None:
    """Trees at random places that keep apart from each other and from given points."""
    taken: list[Array] = []
    for i in range(count):
        for _ in range(20):
            at = rect.at(*rng.random(2))
            near = [*taken, *([] if avoid is None else avoid)]
            if all(np.hypot(at[0] - q[0], at[1] - q[1]) > 2.6 for q in near):
                taken.append(at)
                plant(world, f"{name}/tree_{i}", at, rng)
                break


def put_bench(world: World, name: str, at: Array, turn: float) -> None:
    world.always(name, "bench", partial(fur.bench, name, at, turn))
