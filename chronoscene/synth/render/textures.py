"""Procedural textures: linear albedo of a surface point, compiled.

Each function gets the style row, texture coordinates in metres, the patch extents, a seed and the
pixel width ``fw`` on the surface, and returns a linear RGB triple. The kinds are the constants
below; `albedo` dispatches on them.
"""

from __future__ import annotations

from chronoscene.kernels.compilation import inner
from chronoscene.synth.render import texture_ground as ground
from chronoscene.synth.render import texture_walls as walls

PLAIN, PLASTER, BRICK, PANEL, CONCRETE, TILES, FLAT_ROOF, ASPHALT, PAVING, GRASS = range(10)
SOIL, LEAVES, WOOD, PAINT, CORRUGATED, FIELDS, GLASS, SIGN, WATER, SOLAR, DOOR = range(10, 21)


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
        c = ground.leaves(s, x, y, z, seed, fw)
    elif kind == WOOD:
        c = walls.wood(s, u, v, seed, fw)
    elif kind == PAINT:
        c = walls.paint(s, u, v, su, sv, seed, fw)
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
        c = walls.solar(s, u, v, seed, fw)
    elif kind == DOOR:
        c = walls.door(s, u, v, su, sv, seed, fw)
    else:
        c = walls.plain(s, u, v, seed, fw)
    return (min(0.92, max(0.004, c[0])), min(0.92, max(0.004, c[1])), min(0.92, max(0.004, c[2])))
