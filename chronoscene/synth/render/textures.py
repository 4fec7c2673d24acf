"""Procedural textures: linear albedo of a surface point, compiled.

Each function gets the style row, texture coordinates in metres, the patch extents, a seed and the
pixel width ``fw`` on the surface, and returns a linear RGB triple. The kinds are the constants
below; `albedo` dispatches on them.
"""

from __future__ import annotations

import math

from chronoscene.kernels.compilation import inner
from chronoscene.synth.render import texture_ground as ground
from chronoscene.synth.render import texture_walls as walls
from chronoscene.synth.render.noise import (
    colors,
    fade,
    fbm,
    hash01,
    lottery,
    mix,
    pulse,
    scaled,
    smooth,
    value_noise_3d,
)

PLAIN, PLASTER, BRICK, PANEL, CONCRETE, TILES, FLAT_ROOF, ASPHALT, PAVING, GRASS = range(10)
SOIL, LEAVES, WOOD, PAINT, CORRUGATED, FIELDS, GLASS, SIGN, WATER, SOLAR, DOOR = range(10, 21)


@inner
def _leaves(s, x, y, z, seed, fw):  # type: ignore[no-untyped-def]
    """Foliage: cells of leaf size in clumps of light and dark. Numbers: leaf size, accents."""
    c0, c1, c2 = colors(s)
    size = s[10]
    near, middle = fade(size, 0.8 * fw), fade(4.0 * size, fw)
    # Cells are rotated and distorted, so that the leaves do not form rows.
    wx = (0.8 * x - 0.6 * y) / size + 0.9 * math.sin(2.3 * z / size)
    wy = (0.6 * x + 0.8 * y) / size + 0.9 * math.sin(1.9 * z / size + 1.0)
    wz = z / size + 0.8 * math.sin(2.1 * (x + 0.4 * y) / size)
    ix, iy, iz = math.floor(wx), math.floor(wy), math.floor(wz)
    pick = hash01(ix, iy, seed + 1 + 977 * iz)
    coarse = value_noise_3d(wx / 9.0, wy / 9.0, wz / 9.0, seed)
    clump = middle * value_noise_3d(wx / 3.5, wy / 3.5, wz / 3.5, seed + 3)
    color = mix(c0, c1, min(1.0, max(0.0, 0.5 + 0.7 * coarse + 0.6 * near * (pick - 0.5))))
    color = mix(color, c2, lottery(hash01(ix, iy, seed + 2 + 977 * iz), s[11], near))
    return scaled(color, max(0.2, 0.9 + 0.45 * clump + 0.2 * coarse + 0.6 * near * (pick - 0.5)))


@inner
def _wood(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Boards along u. Numbers: board width, gap."""
    c0, c1, _ = colors(s)
    board = math.floor(v / s[10])
    color = mix(c0, c1, 0.3 + 0.5 * hash01(board, 0, seed))
    color = scaled(color, 1.0 + 0.35 * fbm(u * 0.4, v * 5.0, 0.5, 3, seed + 1, fw))
    return scaled(color, 1.0 - 0.75 * pulse(v, s[10], s[11], fw))


@inner
def _paint(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Smooth paint with darker edges and dust (c2). Numbers: dust."""
    c0, _, c2 = colors(s)
    edge = min(min(u, su - u), min(v, sv - v))
    color = scaled(c0, 0.8 + 0.2 * smooth(0.0, 0.12, edge))
    dust = s[10] * (0.5 + 0.6 * fbm(u, v, 0.8, 4, seed, fw))
    return mix(color, c2, min(1.0, max(0.0, dust)))


@inner
def _solar(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    c0, c1, c2 = colors(s)
    color = mix(c0, c1, max(pulse(u, 0.16, 0.02, fw), pulse(v, 0.16, 0.02, fw)))
    return mix(color, c2, max(pulse(u + 0.02, 1.0, 0.05, fw), pulse(v + 0.02, 1.6, 0.05, fw)))


@inner
def albedo(s, u, v, x, y, z, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Linear albedo of a point.

    Args:
        s: Style row.
        u, v: Texture coordinates in metres.
        x, y, z: World coordinates in metres, for the textures that ignore the frame.
        su, sv: Extents of the patch along u and v in metres.
        seed: Texture seed of the patch.
        fw: Width of a pixel on the surface in metres.
    """
    kind = int(s[0])
    if kind == PLASTER:
        c = walls.plaster(s, u, v, seed, fw)
    elif kind == BRICK:
        c = walls.brick(s, u, v, seed, fw)
    elif kind == PANEL:
        c = walls.panel(s, u, v, seed, fw)
    elif kind == CONCRETE:
        c = walls.concrete(s, u, v, seed, fw)
    elif kind == TILES:
        c = ground.tiles(s, u, v, seed, fw)
    elif kind == FLAT_ROOF:
        c = ground.flat_roof(s, u, v, su, sv, seed, fw)
    elif kind == ASPHALT:
        c = ground.asphalt(s, u, v, su, sv, seed, fw)
    elif kind == PAVING:
        c = ground.paving(s, u, v, su, sv, seed, fw)
    elif kind == GRASS:
        c = ground.grass(s, x, y, seed, fw)
    elif kind == SOIL:
        c = ground.soil(s, u, v, seed, fw)
    elif kind == LEAVES:
        c = _leaves(s, x, y, z, seed, fw)
    elif kind == WOOD:
        c = _wood(s, u, v, seed, fw)
    elif kind == PAINT:
        c = _paint(s, u, v, su, sv, seed, fw)
    elif kind == CORRUGATED:
        c = walls.corrugated(s, u, v, su, sv, seed, fw)
    elif kind == FIELDS:
        c = ground.fields(s, x, y, seed, fw)
    elif kind == GLASS:
        c = walls.glass(s, u, v, su, sv, seed, fw)
    elif kind == SIGN:
        c = walls.sign(s, u, v, su, sv, seed, fw)
    elif kind == WATER:
        c = ground.water(s, x, y, seed, fw)
    elif kind == SOLAR:
        c = _solar(s, u, v, seed, fw)
    elif kind == DOOR:
        c = walls.door(s, u, v, su, sv, seed, fw)
    else:
        c = walls.plain(s, u, v, seed, fw)
    return (min(0.92, max(0.004, c[0])), min(0.92, max(0.004, c[1])), min(0.92, max(0.004, c[2])))
