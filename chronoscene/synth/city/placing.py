"""Placing of objects on blocks and along kerbs: ground, cars, lamps, trees and buildings."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import furniture as fur
from chronoscene.synth.city import palettes as pal
from chronoscene.synth.city.buildings import Building, finished
from chronoscene.synth.city.ground import SLAB, Rect, floor, pavement
from chronoscene.synth.city.vegetation import hedge, tree
from chronoscene.synth.city.world import World, looks, tree_heights
from chronoscene.synth.render.mesh import Mesh, MeshBuilder, X, Y
from chronoscene.synth.render.noise import key_number, rng_for

PARKING = 2.0  # Width of the parking lane at each side of a road, metres
RING = 3.0  # Width of pavements, metres


@dataclass(frozen=True, slots=True, eq=False)
class Block:
    """A block of the city; adds objects to the world under names that start with its own."""

    world: World
    name: str
    inner: Rect
    """The area inside the pavement."""
    rng: np.random.Generator

    @classmethod
    def paved(cls, world: World, name: str, rect: Rect, ring: float = RING) -> Block:
        """A block with a pavement around it."""
        make = partial(pavement, name, rect, ring, world.seed)
        world.always(f"{name}/pavement", "ground", make)
        return cls(world, name, rect.inset(ring), rng_for(world.seed, name))

    def named(self, label: str) -> str:
        """Name of something in the block."""
        return f"{self.name}/{label}" if label else self.name

    def put(
        self, label: str, kind: str, make: Callable[..., Mesh], *args: Any,
        present: Sequence[bool] | None = None,
    ) -> None:  # fmt: skip
        """Add an object, in all periods by default; ``make`` receives its name and ``args``."""
        name, every = self.named(label), [True] * self.world.periods
        self.world.place(name, kind, present or every, partial(make, name, *args))

    def pave(self, label: str, rect: Rect, surface: str) -> None:
        """Add ground that never changes; see `floor`."""
        self.world.always(self.named(label), "ground", partial(floor, self.name, rect, surface))

    def lawn(self, rect: Rect, label: str = "", *, kind: str = "lawn", z: float = SLAB) -> None:
        """Add grass that changes with the seasons."""
        name = self.named(label)
        states = [f"{kind} {season}" for season in self.world.seasons]
        self.world.add(f"{name}/lawn", "lawn", states, lambda s: floor(name, rect, s, z=z))

    def plant(self, label: str, at: Array, *, size: float = 6.5, broad: bool = False) -> None:
        """Add a tree that grows, and may be planted late or felled."""
        world = self.world
        height = float(self.rng.uniform(0.75, 1.25) * size)
        heights = tree_heights(self.rng, world.periods, height)
        self.tree(label, at, heights, detail=2, broad=broad)

    def tree(
        self, label: str, at: Array, heights: Sequence[float | None], *, detail: int, broad: bool
    ) -> None:
        """Add a tree with the given height in each period; None where it is absent."""
        states = [
            None if height is None else (height, season)
            for height, season in zip(heights, self.world.seasons, strict=True)
        ]
        name = self.named(label)
        make = partial(tree, name, at, self.world.seed, detail, broad)
        self.world.add(name, "tree", states, make)

    def scatter_trees(self, rect: Rect, count: int, avoid: Sequence[Array] = ()) -> None:
        """Add trees at random places, away from each other and from the points in ``avoid``."""
        taken = list(avoid)
        for i in range(count):
            for _ in range(20):
                at = rect.at(*self.rng.random(2))
                if all(np.hypot(at[0] - q[0], at[1] - q[1]) > 2.6 for q in taken):
                    taken.append(at)
                    self.plant(f"tree_{i}", at)
                    break

    def hedge(self, label: str, low: Array, high: Array) -> None:
        """Add a hedge between two points."""
        name = self.named(label)
        make = partial(hedge, name, low, high, self.world.seed)
        self.world.add(name, "tree", self.world.seasons, make)

    def gravel_path(self, label: str, points: Array, *, width: float) -> None:
        """Add a gravel path along a curve, slightly above the lawn."""
        way = np.gradient(points, axis=0)
        way /= np.linalg.norm(way, axis=1, keepdims=True)
        side = np.column_stack([-way[:, 1], way[:, 0]]) * width / 2
        height = np.full(len(points), SLAB + 0.02)

        def make(name: str) -> Mesh:
            b = MeshBuilder(key_number(name))
            style = pal.soil_style(b, stones=0.05, ruts=0.0)
            left = np.column_stack([points + side, height])
            right = np.column_stack([points - side, height])
            frame = (np.zeros(3), X, Y)
            for i in range(len(points) - 1):
                b.polygon([right[i], right[i + 1], left[i + 1], left[i]], style, frame=frame)
            return b.build()

        self.put(label, "ground", make)

    def house(self, spec: Building, chance: float) -> None:
        """Add a finished building whose facade may be renewed once, with the given chance."""
        world = self.world
        rng = rng_for(world.seed, spec.name, "reclad")
        states = looks(rng, world.periods, chance)
        walls = (spec.wall, str(rng.choice(["plaster", "panel", "brick"])))
        world.add(
            spec.name,
            "facade",
            [(walls[s], s) for s in states],
            lambda s: finished(replace(spec, wall=s[0], look=s[1]), world.seed),
        )

    def park_cars(
        self, label: str, places: list[tuple[float, float, float, float]], *, chance: float
    ) -> None:
        """Add parked cars: a place (x, y, z, heading) is empty or taken in each period."""
        periods = range(self.world.periods)
        rng = rng_for(self.world.seed, self.named(label), "cars")
        for i, (x, y, z, turn) in enumerate(places):
            stay = rng.random() < 0.2
            here = rng.random(len(periods)) < chance
            heading = turn + rng.normal(0, 0.03) + (np.pi if rng.random() < 0.3 else 0)
            groups = [list(periods)] if stay else [[p] for p in periods]
            for k, group in enumerate(groups):
                present = [p in group and bool(here[group[0]]) for p in periods]
                name = f"{label}/car_{i}_{k}".lstrip("/")
                self.car(name, np.array([x, y, z]), heading=heading, present=present)

    def car(self, label: str, at: Array, *, heading: float, present: Sequence[bool]) -> None:
        self.put(label, "car", fur.car, at, heading, self.world.seed, present=present)


def curb_side(world: World, name: str, rect: Rect) -> None:
    """Add parked cars, lamps and street trees around a block."""
    block = Block(world, name, rect, rng_for(world.seed, name, "avenue"))
    places = []
    off = PARKING / 2
    step = 5.5
    for k in range(int((rect.size[0] - 10) // step)):
        x = rect.x0 + 8.0 + k * step
        places += [(x, rect.y0 - off, 0.0, 0.0), (x, rect.y1 + off, 0.0, np.pi)]
    for k in range(int((rect.size[1] - 10) // step)):
        y = rect.y0 + 8.0 + k * step
        places += [(rect.x0 - off, y, 0.0, np.pi / 2), (rect.x1 + off, y, 0.0, -np.pi / 2)]
    block.park_cars("", places, chance=0.3 if world.near else 0.42)
    _lamps(block)
    _avenue(block)


def _lamps(block: Block) -> None:
    """Add lamps along the kerb, with their arms over the road."""
    r = block.inner.inset(0.8)
    dx, dy = r.size
    along = np.linspace(0.2, 0.8, max(1, int(dx // 18)))
    across = np.linspace(0.3, 0.7, max(1, int(dy // 22)))
    spots = [(f, 0.0, -np.pi / 2) for f in along] + [(f, 1.0, np.pi / 2) for f in along]
    spots += [(0.0, f, np.pi) for f in across] + [(1.0, f, 0.0) for f in across]
    for i, (fx, fy, turn) in enumerate(spots):
        block.put(f"lamp_{i}", "lamp", fur.lamp, r.at(fx, fy), turn)


def _avenue(block: Block) -> None:
    """Add street trees in pits along some sides of a block."""
    rng, r = block.rng, block.inner.inset(1.0)
    ends = [r.at(0, 0), r.at(1, 0), r.at(1, 1), r.at(0, 1), r.at(0, 0)]
    for side, (a, b) in enumerate(pairwise(ends)):
        if rng.random() < 0.45:
            continue
        length = float(np.linalg.norm(b - a))
        for i in range(int((length - 10) // 9.5)):
            at = a + (8.0 + 9.5 * i + rng.uniform(-0.5, 0.5)) / length * (b - a)
            label = f"avenue_{side}{i}"
            make = partial(floor, block.named(label), Rect.around(at, 0.6), "soil", z=SLAB + 0.015)
            block.world.always(block.named(f"{label}/pit"), "ground", make)
            block.plant(label, at, size=5.6, broad=True)
