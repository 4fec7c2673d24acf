"""Roofs with what stands on them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.synth.city import palettes as pal
from chronoscene.synth.render.mesh import PartBuilder, srgb
from chronoscene.synth.render.textures import SOLAR

Array = NDArray[np.float64]
X, Y, Z = np.eye(3)


def flat_roof(
    b: PartBuilder,
    corner: Array,
    size: tuple[float, float],
    wall: int,
    rng: np.random.Generator,
    *,
    plain: bool,
) -> None:
    """Parapet, surface, and boxes: stair heads, ventilation, solar panels.

    Args:
        b: Receives the geometry.
        corner: Lowest corner of the roof. [3]
        size: Extent along x and y.
        wall: Style of the parapet's outside.
        rng: Draws the boxes.
        plain: Leave the small things out.
    """
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
    b: PartBuilder, corner: Array, dx: float, dy: float, rng: np.random.Generator
) -> None:
    """Boxes in the cells of a grid, so that they never overlap."""
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


def pitched_roof(
    b: PartBuilder,
    corner: Array,
    size: tuple[float, float],
    kind: str,
    wall: int,
    rng: np.random.Generator,
    *,
    plain: bool,
) -> None:
    """Gable or hip roof with its ridge along the longer side, chimneys and dormers.

    Args:
        b: Receives the geometry.
        corner: Lowest corner of the roof. [3]
        size: Extent along x and y.
        kind: ``gable`` or ``hip``.
        wall: Style of the gables.
        rng: Draws slope, chimneys, dormers.
        plain: Leave the small things out.
    """
    tiles = pal.roof_tile_style(b, rng)
    fascia = pal.wood_style(b, srgb(110, 84, 62))
    dx, dy = size
    if dx >= dy:
        o, a, c, length, depth = corner, X, Y, dx, dy
    else:
        o, a, c, length, depth = corner + dx * X, Y, -X, dy, dx
    slope = float(rng.uniform(0.62, 0.9))
    eave = 0.45
    rise = slope * depth / 2
    drop = slope * eave
    if kind == "hip":
        _hip(b, o, a, c, length, depth, rise, eave, drop, tiles, fascia)
    else:
        _gable(b, o, a, c, length, depth, rise, eave, drop, tiles, fascia, wall)
    if plain:
        return
    brick = pal.wall_style(b, "brick", rng, 9.0)
    for f in rng.uniform(0.2, 0.8, int(rng.integers(1, 3))):
        side = float(rng.uniform(0.3, 0.42))
        at = o + f * length * a + side * depth * c + (2 * side * rise - 0.5) * Z
        b.boxes(at, 0.7 * a, 0.5 * c, 2.1 * Z, brick, bottom=False)
    if kind == "gable" and length > 9:
        _dormers(b, o, a, c, length, depth, rise, tiles, wall, rng)


def _gable(
    b: PartBuilder,
    o: Array,
    a: Array,
    c: Array,
    length: float,
    depth: float,
    rise: float,
    eave: float,
    drop: float,
    tiles: int,
    fascia: int,
    wall: int,
) -> None:
    """Two slopes with thickness and two gable walls."""
    over = 0.3
    ridge = rise * Z + depth / 2 * c
    low = o - over * a - eave * c - drop * Z
    span = (length + 2 * over) * a
    up = ridge + eave * c + drop * Z
    low2 = o + (length + over) * a + (depth + eave) * c - drop * Z
    up2 = ridge - depth * c - eave * c + drop * Z
    b.quads(low + 0.2 * Z, span, up, tiles)
    b.quads(low2 + 0.2 * Z, -span, up2, tiles, seed=3)
    for corner, s, u in ((low, span, up), (low2, -span, up2)):
        b.quads(corner, u, s, fascia)
        b.quads(corner, s, 0.2 * Z, fascia)
        b.quads(corner + s, u, 0.2 * Z, fascia)
        b.quads(corner + u, -u, 0.2 * Z, fascia)
    east = o + length * a
    b.polygon([east, east + depth * c, east + ridge], wall, frame=(east, c, Z))
    west = o + depth * c
    b.polygon([west, o, o + ridge], wall, frame=(west, -c, Z))


def _hip(
    b: PartBuilder,
    o: Array,
    a: Array,
    c: Array,
    length: float,
    depth: float,
    rise: float,
    eave: float,
    drop: float,
    tiles: int,
    fascia: int,
) -> None:
    """Four slopes; the ridge is shorter than the house by its depth."""
    run = min(depth, length) / 2
    p = [
        o - eave * a - eave * c - drop * Z,
        o + (length + eave) * a - eave * c - drop * Z,
        o + (length + eave) * a + (depth + eave) * c - drop * Z,
        o - eave * a + (depth + eave) * c - drop * Z,
    ]
    r0 = o + run * a + depth / 2 * c + rise * Z
    r1 = o + (length - run) * a + depth / 2 * c + rise * Z
    lift = 0.02 * Z
    for i, top in enumerate(([r1, r0], [r1], [r0, r1], [r0])):
        first, second = p[i], p[(i + 1) % 4]
        u = (second - first) / np.linalg.norm(second - first)
        normal = np.cross(second - first, top[0] - first)
        v = np.cross(normal / np.linalg.norm(normal), u)
        b.polygon([first + lift, second + lift, *(t + lift for t in top)], tiles,
                  frame=(first, u, v), seed=i)  # fmt: skip
        b.quads(first - 0.16 * Z, second - first, 0.18 * Z, fascia)
    b.quads(p[0] - 0.16 * Z, p[3] - p[0], p[1] - p[0], fascia)


def _dormers(
    b: PartBuilder,
    o: Array,
    a: Array,
    c: Array,
    length: float,
    depth: float,
    rise: float,
    tiles: int,
    wall: int,
    rng: np.random.Generator,
) -> None:
    """Small houses in the slopes, with a window each."""
    glass = pal.glass_style(b, pal.WHITE)
    for side in (0, 1):
        count = int(rng.integers(0, max(2, int(length // 5))))
        for i in range(count):
            x = (i + 0.5) * length / count
            axis, start = (a, o) if side == 0 else (-a, o + length * a + depth * c)
            inwards = c if side == 0 else -c
            at = start + (x - 0.75) * axis + 0.16 * depth * inwards
            base = at + (0.32 * rise - 0.1) * Z
            deep = 0.26 * depth
            b.boxes(base, 1.5 * axis, deep * inwards, 1.5 * Z, wall, bottom=False)
            out = -0.02 * inwards
            b.quads(base + out + 0.25 * axis + 0.35 * Z, axis, 1.0 * Z, glass, seed=i + 7 * side)
            roof = base + 1.5 * Z - 0.2 * axis - 0.25 * inwards
            b.boxes(roof, 1.9 * axis, (deep + 0.3) * inwards, 0.14 * Z, tiles)
