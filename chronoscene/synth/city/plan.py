"""The plan of a city: blocks, roads, what stands on them and how that changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.synth.city import blocks as fill
from chronoscene.synth.city.ground import road_network, surroundings
from chronoscene.synth.city.placing import Rect, curb_side
from chronoscene.synth.city.world import World
from chronoscene.synth.render.light import make_lights
from chronoscene.synth.render.noise import rng_for
from chronoscene.synth.settings import SynthSettings

Array = NDArray[np.float64]
ROAD = 9.6
"""Width of roads with parked cars on both sides, metres."""


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """Grid of blocks; the outermost ring is suburb."""

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


REBUILT = ("houses", "slabs", "tower", "park")
"""What may stand on a block after all of it was torn down."""


def make_world(settings: SynthSettings) -> World:
    """Build all objects of all periods."""
    plan = make_plan(settings)
    n = settings.blocks
    core = np.array([[plan.x[1, 0], plan.y[1, 0]], [plan.x[n, 1], plan.y[n, 1]]])
    world = World(settings.seed, make_lights(settings.seed, settings.periods), core)
    world.near = settings.kind == "street"
    road_network(world, plan.x, plan.y, ROAD)
    for (column, row), role in _roles(settings).items():
        name = f"block_{column}{row}"
        rect = plan.rect(column, row)
        _fill(world, settings, name, rect, role)
        if role != "suburb":
            x, y = rect.center
            world.focus.append(np.array([x, y, 3.0]))
            curb_side(world, name, rect, ROAD)
    surroundings(world, plan.x, plan.y)
    return world


def _fill(world: World, settings: SynthSettings, name: str, rect: Rect, role: str) -> None:
    """Build on a block; at one date it may be torn down, and something else be built."""
    build = fill.FILLERS[role]
    rng = rng_for(settings.seed, name, "rebuilt")
    if world.periods == 1 or rng.random() >= settings.rebuilt:
        build(world, name, rect)
        return
    date = int(rng.integers(1, world.periods))
    with world.during(range(date)):
        build(world, name, rect)
    other = role if role == "suburb" else str(rng.choice(sorted({*REBUILT} - {role})))
    with world.during(range(date, world.periods)):
        fill.FILLERS[other](world, f"{name}_rebuilt", rect)


def _roles(settings: SynthSettings) -> dict[tuple[int, int], str]:
    """What each block is: one square, one building site, one renewal, parks, houses, slabs."""
    rng = rng_for(settings.seed, "roles")
    n = settings.blocks
    cells = [(i, j) for i in range(1, n + 1) for j in range(1, n + 1)]
    middle = (n + 1) / 2
    rng.shuffle(cells)
    cells.sort(key=lambda c: max(abs(c[0] - middle), abs(c[1] - middle)))
    wanted = ["square", "site", "renewal", "houses"]
    others = ["houses", "slabs", "houses", "park", "tower", "slabs"]
    rest = [others[k % len(others)] for k in range(len(cells) - len(wanted))]
    tail = wanted[1:] + rest
    rng.shuffle(tail)
    roles = dict(zip(cells, ["square", *tail], strict=True))
    for i in range(n + 2):
        for j in range(n + 2):
            roles.setdefault((i, j), "suburb")
    return roles
