"""Fillers of blocks: square, park, houses, slabs, tower, building site, renewal, suburb."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from chronoscene.arrays import Array
from chronoscene.synth.city import furniture as fur
from chronoscene.synth.city.buildings import Building, finished, foundation, frame, rubble
from chronoscene.synth.city.ground import SLAB, Rect, floor
from chronoscene.synth.city.placing import Block
from chronoscene.synth.city.world import renewal_stages, site_stages, visits
from chronoscene.synth.render.mesh import Mesh, X
from chronoscene.synth.render.noise import rng_for


def square(block: Block) -> None:
    """Paved square with a fountain or statue, trees, benches, kiosks and market stalls."""
    world, name, inner, rng = block.world, block.name, block.inner, block.rng
    block.pave("paving", inner, str(rng.choice(["rings", "bands"])))
    mid = inner.at(0.5, 0.5)
    radius = min(3.6, 0.13 * min(inner.size))
    if rng.random() < 0.6:
        world.always(f"{name}/fountain", "monument", lambda: fur.fountain(name, mid, radius))
    else:
        world.always(f"{name}/statue", "monument", lambda: fur.statue(name, mid))
    for i, (fx, fy) in enumerate(((0.17, 0.17), (0.83, 0.17), (0.83, 0.83), (0.17, 0.83))):
        c, w = inner.at(fx, fy), 0.11 * min(inner.size)
        bed = Rect.around(c, w)
        block.lawn(bed, f"bed_{i}", kind="mown", z=SLAB + 0.03)
        for j in range(1 if w < 2.5 else 3):
            at = bed.at(*rng.uniform(0.2, 0.8, 2)) if w >= 2.5 else bed.at(0.5, 0.5)
            block.plant(f"tree_{i}{j}", at)
        side = np.sign(0.5 - fx)
        block.put(f"bench_{i}", "bench", fur.bench, c + side * (w + 0.8) * X, -side * np.pi / 2)
    for i in range(max(2, int(min(inner.size) // 7))):
        at = inner.at(*rng.uniform(0.3, 0.7, 2))
        if np.linalg.norm((at - mid)[:2]) < radius + 3.5:
            at = mid + _flat_unit(at - mid) * (radius + 4.5)
        turn = float(rng.uniform(0, 6.28))
        label, make = (f"stall_{i}", fur.stall) if i % 2 else (f"kiosk_{i}", fur.kiosk)
        here = visits(rng, world.periods, 0.5)
        block.put(label, "kiosk", make, at, turn, world.seed, present=here)


def _flat_unit(v: Array) -> Array:
    """Horizontal direction of a vector; +x if it is vertical."""
    flat = np.array([v[0], v[1], 0.0])
    norm = np.linalg.norm(flat)
    return flat / norm if norm > 1e-6 else X


def park(block: Block) -> None:
    """Lawn with paths, trees, hedges and benches."""
    inner, rng = block.inner, block.rng
    block.lawn(inner)
    t = np.linspace(0, 1, 25)
    bend = rng.uniform(-0.16, 0.16, 2)
    first = np.stack([t, 0.2 + 0.6 * t + bend[0] * np.sin(np.pi * t)], axis=1)
    second = np.stack([0.75 - 0.5 * t + bend[1] * np.sin(2 * np.pi * t), t], axis=1)
    low, size = np.array([inner.x0, inner.y0]), np.array(inner.size)
    curves = low + np.concatenate([first, second]) * size
    for i, curve in enumerate((curves[:25], curves[25:])):
        block.gravel_path(f"path_{i}", curve, width=2.2)
    block.scatter_trees(inner, int(np.prod(size) / 70), curves)
    for i in range(4):
        k = int(rng.integers(4, 20)) + 25 * (i % 2)
        at = np.array([*(curves[k] + [1.6, 1.0]), SLAB])
        block.put(f"bench_{i}", "bench", fur.bench, at, float(rng.uniform(0, 6.28)))
    block.hedge("hedge_s", inner.at(0.05, 0.03), inner.at(0.6, 0.03))
    block.hedge("hedge_e", inner.at(0.97, 0.3), inner.at(0.97, 0.95))


def houses(block: Block) -> None:
    """Rows of terraced houses along one or two sides, with a courtyard behind them."""
    inner, rng = block.inner, block.rng
    dx, dy = inner.size
    depth = min(11.0, 0.42 * dy) if dy > 20 else min(11.0, 0.75 * dy)
    rows = [(inner.y0, inner.y0 + depth, 0)]
    if dy - depth > 13:
        rows.append((inner.y1 - depth, inner.y1, 2))
    for r, (y0, y1, street) in enumerate(rows):
        count = max(1, round(dx / rng.uniform(9.5, 13)))
        cuts = inner.x0 + dx * np.concatenate(
            [[0], (np.arange(1, count) + rng.uniform(-0.15, 0.15, count - 1)) / count, [1]]
        )
        shops = bool(rng.random() < 0.6)
        for i in range(count):
            spec = Building(
                block.named(f"house_{r}{i}"), Rect(cuts[i], y0, cuts[i + 1], y1),
                storeys=int(rng.integers(2, 6)),
                roof=str(rng.choice(["gable", "gable", "hip", "flat"])),
                wall=str(rng.choice(["plaster", "plaster", "brick"])),
                blank=(False, i < count - 1, False, i > 0),
                shops=(shops and street == 0, False, shops and street == 2, False),
                balconies=bool(rng.random() < 0.3),
                storey=float(rng.uniform(2.9, 3.3)), ground=float(rng.uniform(3.5, 4.2)),
            )  # fmt: skip
            block.house(_fit_roof(spec), chance=0.35)
    y0, y1 = inner.y0 + depth, (rows[1][0] if len(rows) > 1 else inner.y1)
    yard = Rect(inner.x0, y0, inner.x1, y1)
    block.lawn(yard)
    block.pave("floor_0", Rect(inner.x0, inner.y0, inner.x1, y0), "slabs")
    if len(rows) > 1:
        block.pave("floor_1", Rect(inner.x0, y1, inner.x1, inner.y1), "slabs")
    if y1 - y0 > 4:
        block.scatter_trees(yard.inset(1.5), max(1, int(dx * (y1 - y0) / 130)))


def _fit_roof(spec: Building) -> Building:
    """Terraced houses need their ridge along the street, so narrow ones get a flat roof."""
    width, depth = spec.rect.size
    narrow = width <= depth
    attached = spec.blank[1] or spec.blank[3]
    if attached and (narrow or spec.roof == "hip"):
        return replace(spec, roof="flat" if narrow else "gable")
    return spec


def slabs(block: Block) -> None:
    """A long flat-roofed building on a lawn, with a car park."""
    inner, rng = block.inner, block.rng
    middle = inner.y0 + 0.55 * inner.size[1]
    upper = Rect(inner.x0, middle, inner.x1, inner.y1)
    lower = Rect(inner.x0, inner.y0, inner.x1, middle)
    block.lawn(upper, "north")
    wall = str(rng.choice(["panel", "concrete", "brick", "panel"]))
    deep = min(12.0, upper.size[1] - 3)
    spec = Building(
        block.named("slab"),
        Rect(upper.x0 + 2, upper.y0 + 1.0, upper.x1 - 2, upper.y0 + 1.0 + deep),
        storeys=int(rng.integers(4, 8)), roof="flat", wall=wall,
        balconies=bool(rng.random() < 0.7),
    )  # fmt: skip
    block.house(spec, chance=0.5)
    lot = Rect(lower.x0, lower.y0, lower.x1, lower.y0 + min(17.0, lower.size[1]))
    block.pave("car_park", lot, "car_park")
    places = []
    for k in range(int((lot.size[0] - 1) // 2.6)):
        x = lot.x0 + 1.35 + 2.6 * k
        places += [(x, lot.y0 + 2.5, SLAB, np.pi / 2), (x, lot.y1 - 2.5, SLAB, np.pi / 2)]
    block.park_cars("lot", places if lot.size[1] > 11 else places[::2], chance=0.4)
    if lot.y1 < lower.y1 - 0.5:
        rest = Rect(lower.x0, lot.y1, lower.x1, lower.y1)
        block.lawn(rest, "strip", kind="mown")
        if rest.size[1] > 3:
            block.scatter_trees(rest.inset(1.2), int(rest.size[0] // 8))


def tower(block: Block) -> None:
    """A high-rise with a low wing, on paving with a planted bed."""
    inner, rng = block.inner, block.rng
    block.pave("paving", inner, "bands")
    w = min(16.0, 0.5 * min(inner.size))
    x0, y0 = inner.at(*rng.uniform(0.08, 0.3, 2))[:2]
    spec = Building(
        block.named("tower"), Rect(x0, y0, x0 + w, y0 + w), storeys=int(rng.integers(8, 11)),
        roof="flat", wall=str(rng.choice(["panel", "concrete"])),
    )  # fmt: skip
    block.house(spec, chance=0.6)
    if inner.x1 - (x0 + w) > 7:
        wing = Building(
            block.named("wing"), Rect(x0 + w, y0 + 0.2 * w, inner.x1 - 1.5, y0 + 0.85 * w),
            storeys=2, roof="flat", wall="panel",
            blank=(False, False, False, True), shops=(True, False, True, False),
        )  # fmt: skip
        block.house(wing, chance=0.5)
    free = Rect(inner.x0 + 1.5, y0 + w + 2.5, inner.x1 - 1.5, inner.y1 - 1.5)
    if free.size[1] > 3:
        bed = free.inset(0.5)
        block.lawn(bed, kind="mown", z=SLAB + 0.04)
        block.scatter_trees(bed.inset(0.8), int(bed.size[0] * bed.size[1] / 45))


def site(block: Block) -> None:
    """A building site: empty lot, foundation, frame with crane, finished building."""
    world, inner, rng = block.world, block.inner, block.rng
    steps = site_stages(world.periods)
    low, (dx, dy) = inner.at(0.12, 0.16), inner.size
    spec = Building(
        block.named("hall"), Rect(low[0], low[1], low[0] + 0.7 * dx, low[1] + 0.62 * dy),
        storeys=int(rng.integers(4, 7)), roof="flat",
        wall=str(rng.choice(["panel", "brick", "plaster"])),
        shops=(True, False, False, False), storey=3.3,
    )  # fmt: skip
    surfaces = [
        f"mown {season}" if step == "finished" else "soil"
        for step, season in zip(steps, world.seasons, strict=True)
    ]
    ground = block.named("floor")
    world.add(ground, "ground", surfaces, lambda s: floor(block.name, inner, s))

    def make(stage: str) -> Mesh:
        if stage == "foundation":
            return foundation(spec, world.seed)
        if stage.startswith("frame"):
            share = 0.5 if stage == "frame_low" else 0.85
            return frame(spec, max(1, int(share * spec.storeys)), world.seed)
        return finished(spec, world.seed)

    world.add(spec.name, "building", [None if s == "lot" else s for s in steps], make)
    _site_gear(block, steps, spec)
    young = [round(3.2 + 0.6 * p, 2) if s == "finished" else None for p, s in enumerate(steps)]
    for i in range(4):
        block.tree(f"young_{i}", inner.at(0.12 + 0.25 * i, 0.93), young, detail=2, broad=True)


def _site_gear(block: Block, steps: Sequence[str], spec: Building) -> None:
    """Fence, containers, crane and excavator during construction."""
    inner, seed = block.inner, block.world.seed
    busy = [s != "finished" for s in steps]
    high = [s in ("foundation", "frame_low", "frame_high") for s in steps]
    early = [s in ("lot", "foundation") for s in steps]
    r = inner.inset(0.4)
    corners = [(r.x0, r.y0), (r.x1, r.y0), (r.x1, r.y1), (r.x0, r.y1), (r.x0, r.y0)]
    block.put("fence", "fence", fur.fence, corners, SLAB, present=busy)
    for i in range(2):
        at = inner.at(0.25 + 0.4 * i, 0.9)
        block.put(f"container_{i}", "container", fur.container, at, 0.0, seed, present=busy)
    at = np.array([spec.rect.x1 + 0.08 * inner.size[0], spec.rect.center[1], SLAB])
    turn = float(rng_for(seed, block.name, "crane").uniform(2.0, 4.2))
    block.put("crane", "crane", fur.crane, at, turn, spec.wall_height + 9.0, present=high)
    block.put("digger", "digger", fur.digger, inner.at(0.86, 0.12), 2.3, present=early)


def renewal(block: Block) -> None:
    """An old building that is demolished and replaced by a car park, beside a house that stays."""
    world, inner, rng = block.world, block.inner, block.rng
    dx, dy = inner.size
    left = Rect(inner.x0, inner.y0, inner.x0 + 0.6 * dx, inner.y1)
    right = Rect(left.x1, inner.y0, inner.x1, inner.y1)
    steps = renewal_stages(world.periods)
    old = Rect(left.x0 + 1.5, left.y0 + 0.1 * dy, left.x1 - 1.5, left.y0 + 0.72 * dy)
    storeys = int(rng.integers(3, 5))
    spec = Building(block.named("old"), old, storeys=storeys, roof="gable", wall="brick")

    def make(stage: str) -> Mesh:
        return finished(spec, world.seed) if stage == "house" else rubble(spec, world.seed)

    world.add(spec.name, "building", [None if s == "park" else s for s in steps], make)
    surfaces = [{"house": "slabs", "rubble": "soil", "park": "car_park"}[s] for s in steps]
    ground = block.named("floor")
    world.add(ground, "ground", surfaces, lambda s: floor(block.name, left, s))
    for k in range(int((left.size[0] - 1) // 2.6)):
        here = [s == "park" and bool(rng.random() < 0.55) for s in steps]
        at = np.array([left.x0 + 1.35 + 2.6 * k, left.y0 + 2.5, SLAB])
        block.car(f"visitor_{k}", at, heading=np.pi / 2, present=here)
    block.lawn(right)
    new = Rect(right.x0 + 1.0, right.y0 + 0.3 * dy, right.x1 - 0.5, right.y1 - 1.0)
    storeys = int(rng.integers(2, 5))
    beside = Building(block.named("house"), new, storeys=storeys, roof="hip", wall="plaster")
    block.house(beside, chance=0.7)
    garden = Rect(right.x0 + 1, right.y0 + 1, right.x1 - 1, right.y0 + 0.25 * dy)
    block.scatter_trees(garden, 2)


def suburb(block: Block) -> None:
    """Detached houses in gardens, with less detail than in the core."""
    world, inner, rng = block.world, block.inner, block.rng
    block.lawn(inner)
    dx, dy = inner.size
    cols, rows = max(1, int(dx // 18)), max(1, int(dy // 18))
    for i in range(cols):
        for j in range(rows):
            plot = Rect(inner.x0 + i * dx / cols, inner.y0 + j * dy / rows,
                        inner.x0 + (i + 1) * dx / cols, inner.y0 + (j + 1) * dy / rows)  # fmt: skip
            w, d = rng.uniform(0.42, 0.62, 2) * plot.size
            x, y = plot.at(*rng.uniform(0.1, 0.3, 2))[:2]
            spec = Building(
                block.named(f"villa_{i}{j}"), Rect(x, y, x + w, y + d),
                storeys=int(rng.integers(1, 4)), roof=str(rng.choice(["gable", "hip"])),
                wall=str(rng.choice(["plaster", "brick"])), ground=3.0, simple=not world.near,
            )  # fmt: skip
            world.always(spec.name, "building", partial(finished, spec, world.seed))
            at = plot.at(0.86, float(rng.uniform(0.2, 0.8)))
            heights = [float(rng.uniform(5, 9))] * world.periods
            detail = 2 if world.near else 1
            block.tree(f"tree_{i}{j}", at, heights, detail=detail, broad=False)


FILLERS: dict[str, Callable[[Block], None]] = {
    "square": square,
    "park": park,
    "houses": houses,
    "slabs": slabs,
    "tower": tower,
    "site": site,
    "renewal": renewal,
    "suburb": suburb,
}
"""Functions that fill a block, by role."""
