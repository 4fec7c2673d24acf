"""Procedural textures: linear albedo of a surface point, compiled.

Each function gets the style row, texture coordinates in metres, the patch extents, a seed and the
pixel width ``fw`` on the surface, and returns a linear RGB triple. The kinds are the constants
below; `albedo` chooses among them.
"""

from __future__ import annotations

import math

from numba import njit

from chronoscene.synth.noise import (
    fade,
    fbm,
    hash01,
    lottery,
    mix,
    pulse,
    scaled,
    smooth,
    span,
    value_noise_3d,
)

PLAIN, PLASTER, BRICK, PANEL, CONCRETE, TILES, FLAT_ROOF, ASPHALT, PAVING, GRASS = range(10)
SOIL, LEAVES, WOOD, PAINT, CORRUGATED, FIELDS, GLASS, SIGN, WATER, SOLAR, DOOR = range(10, 21)


@njit(cache=True)
def _colors(s):  # type: ignore[no-untyped-def]
    return (s[1], s[2], s[3]), (s[4], s[5], s[6]), (s[7], s[8], s[9])


@njit(cache=True)
def _weather(color, u, v, seed, fw, strength):  # type: ignore[no-untyped-def]
    """Blotches, streaks that run down, and grain: what keeps real walls from being flat."""
    blotch = fbm(u, v, 2.6, 5, seed + 11, fw)
    streak = fbm(u * 3.0, v * 0.35, 1.0, 3, seed + 12, 0.6 * fw)
    return scaled(color, max(0.25, 1.0 + strength * (0.75 * blotch + 0.45 * streak)))


@njit(cache=True)
def _plain(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Noise only. Numbers: strength, size."""
    c0, c1, _ = _colors(s)
    n = fbm(u, v, max(s[11], 0.05), 4, seed, fw)
    return scaled(mix(c0, c1, smooth(-0.5, 0.6, n)), max(0.2, 1.0 + s[10] * n))


@njit(cache=True)
def _plaster(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Plaster with a dirty base and spots where it came off (c1). Numbers: wear, storey, rows."""
    c0, c1, c2 = _colors(s)
    color = _weather(c0, u, v, seed, fw, 0.22)
    worn = smooth(0.72 - 0.4 * s[10], 0.84 - 0.4 * s[10], fbm(u, v, 1.3, 5, seed + 21, fw) + 0.25)
    color = mix(color, c1, 0.6 * worn)
    base = math.exp(-max(v, 0.0) / 0.5) * (0.8 + 0.5 * fbm(u, v, 0.9, 3, seed + 22, fw))
    color = mix(color, c2, min(0.55, max(0.0, 0.5 * base)))
    if s[11] > 0.0:  # a painted line under each storey
        line = pulse(v - s[12], s[11], 0.16, fw)
        color = mix(color, c2, 0.45 * line)
    return color


@njit(cache=True)
def _brick(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Running bond; c0 and c1 bricks, c2 mortar. Numbers: length, height, band period."""
    c0, c1, c2 = _colors(s)
    length, height = s[10], s[11]
    row = math.floor(v / height)
    shifted = u + 0.5 * length * (row & 1)
    col = math.floor(shifted / length)
    pick = hash01(col, row, seed) - 0.5
    near = fade(height, fw)
    color = mix(c0, c1, 0.5 + near * pick + 0.35 * fbm(u, v, 2.2, 4, seed + 5, fw))
    color = scaled(color, 1.0 + 0.35 * near * (hash01(col, row, seed + 1) - 0.5))
    joint = max(pulse(v, height, 0.014, fw), pulse(shifted, length, 0.014, fw))
    color = mix(color, c2, joint)
    if s[12] > 0.0:
        color = mix(color, scaled(c1, 0.6), 0.7 * pulse(v, s[12], 0.24, fw))
    return _weather(color, u, v, seed, fw, 0.16)


@njit(cache=True)
def _panel(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Cladding panels with dark joints (c2). Numbers: width, height, share of c1, gloss bands."""
    c0, c1, c2 = _colors(s)
    col, row = math.floor(u / s[10]), math.floor(v / s[11])
    seen = fade(min(s[10], s[11]), fw)
    accent = hash01(0, row // 2, seed + 3) < s[12] or hash01(col, 0, seed + 4) < 0.4 * s[12]
    color = mix(c0, c1, 1.0 if accent else 0.0)
    color = scaled(color, 1.0 + 0.22 * seen * (hash01(col, row, seed) - 0.5))
    joint = max(pulse(u + 0.015, s[10], 0.05, fw), pulse(v + 0.015, s[11], 0.05, fw))
    color = mix(color, c2, joint)
    return _weather(color, u, v, seed, fw, 0.12)


@njit(cache=True)
def _concrete(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Cast concrete. Numbers: formwork width, height."""
    c0, c1, _ = _colors(s)
    col, row = math.floor(u / s[10]), math.floor(v / s[11])
    color = scaled(c0, 1.0 + 0.16 * (hash01(col, row, seed) - 0.5))
    color = mix(color, c1, 0.5 * smooth(0.0, 0.7, fbm(u * 2.0, v * 0.5, 1.3, 4, seed + 2, fw)))
    joint = max(pulse(u + 0.01, s[10], 0.03, fw), pulse(v + 0.01, s[11], 0.03, fw))
    color = scaled(color, 1.0 - 0.45 * joint)
    hole = pulse(u - 0.4 * s[10], s[10], 0.07, fw) * pulse(v - 0.5 * s[11], s[11], 0.07, fw)
    return _weather(scaled(color, 1.0 - 0.6 * hole), u, v, seed, fw, 0.2)


@njit(cache=True)
def _tiles(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Roof tiles, v up the slope; c0 and c1 tiles, c2 moss. Numbers: width, height, moss."""
    c0, c1, c2 = _colors(s)
    width, height = s[10], s[11]
    row = math.floor(v / height)
    shifted = u + 0.5 * width * (row & 1)
    col = math.floor(shifted / width)
    near = fade(width, fw)
    pick = hash01(col, row, seed) - 0.5
    color = mix(c0, c1, 0.5 + near * pick + 0.4 * fbm(u, v, 1.6, 4, seed + 4, fw))
    f, g = v / height - row, shifted / width - col
    curve = 4.0 * g * (1.0 - g)
    shade = (0.62 + 0.5 * f) * (0.75 + 0.35 * curve)
    color = scaled(color, 1.0 + near * (shade - 0.95))
    # Courses stay visible from farther away than single tiles.
    color = scaled(color, 1.0 - 0.5 * pulse(v, height, 0.05, fw))
    patch = hash01(math.floor(u / (7 * width)), math.floor(v / (5 * height)), seed + 9)
    color = scaled(color, 0.9 + 0.22 * patch)
    moss = smooth(0.75 - s[12], 1.05 - s[12], fbm(u, v, 1.9, 5, seed + 6, fw) + 0.35)
    return mix(color, c2, 0.7 * moss)


@njit(cache=True)
def _flat_roof(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Bitumen sheets or gravel. Numbers: sheet width, gravel (0 or 1)."""
    c0, c1, c2 = _colors(s)
    sheet = math.floor(u / s[10])
    color = scaled(c0, 1.0 + 0.28 * (hash01(sheet, 0, seed) - 0.5))
    cut = 3.0 + 4.0 * hash01(sheet, 1, seed)
    seam = max(pulse(u, s[10], 0.07, fw), pulse(v + 2.0 * hash01(sheet, 2, seed), cut, 0.07, fw))
    color = mix(color, c1, (1.0 - s[11]) * 0.7 * seam)
    if s[11] > 0.0:
        color = scaled(color, 1.0 + 0.5 * fbm(u, v, 0.22, 3, seed + 3, fw))
    pond = smooth(0.25, 0.45, fbm(u, v, 3.2, 4, seed + 4, fw))
    color = mix(color, c2, 0.55 * pond)
    edge = min(min(u, su - u), min(v, sv - v))
    color = scaled(color, 0.72 + 0.28 * smooth(0.0, 0.7, edge))
    return _weather(color, u, v, seed, fw, 0.25)


@njit(cache=True)
def _asphalt(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Road, u along it. Numbers: marking (0 none, 1 lanes, 2 zebra, 3 parking lot), parking."""
    c0, c1, paint = _colors(s)
    color = mix(c0, c1, smooth(-0.5, 0.6, fbm(u, v, 3.5, 6, seed, fw)))
    color = scaled(color, 1.0 + 0.25 * fbm(u, v, 0.12, 2, seed + 1, fw))
    grain = hash01(math.floor(u / 0.025), math.floor(v / 0.025), seed + 8) - 0.5
    color = scaled(color, 1.0 + 0.3 * grain * fade(0.03, fw))
    # Repairs: rectangles of newer asphalt, and cracks along a line of the noise.
    cu, cv = math.floor(u / 5.3), math.floor(v / 2.9)
    if hash01(cu, cv, seed + 2) < 0.28:
        a, b = 0.6 + 1.5 * hash01(cu, cv, seed + 3), 0.4 + 0.7 * hash01(cu, cv, seed + 4)
        inside = span(u - 5.3 * cu, a, a + 2.4, fw) * span(v - 2.9 * cv, b, b + 1.1, fw)
        color = scaled(color, 1.0 - 0.4 * inside)
    crack = abs(fbm(u, v, 2.1, 3, seed + 5, fw))
    color = scaled(color, 1.0 - 0.45 * (1.0 - smooth(0.0, 0.03 + fw, crack)) * fade(0.15, fw))
    oil = smooth(0.45, 0.6, fbm(u, v, 1.3, 3, seed + 6, fw))
    color = scaled(color, 1.0 - 0.35 * oil)
    mark = _marking(s, u, v, su, sv, fw)
    worn = 0.9 - 0.45 * smooth(-0.1, 0.7, fbm(u, v, 0.7, 4, seed + 7, fw))
    return mix(color, paint, mark * worn)


@njit(cache=True)
def _marking(s, u, v, su, sv, fw):  # type: ignore[no-untyped-def]
    """Share of paint on the road."""
    kind = int(s[10])
    if kind == 1:
        mid = 0.5 * sv
        mark = span(v, mid - 0.08, mid + 0.08, fw) * pulse(u, 6.0, 3.2, fw)
        side = s[11]
        edge = span(v, side, side + 0.12, fw) + span(v, sv - side - 0.12, sv - side, fw)
        if side > 1.0:  # bays for parked cars beside the lanes
            in_bay = span(v, 0.15, side, fw) + span(v, sv - side, sv - 0.15, fw)
            edge += in_bay * pulse(u, 5.5, 0.12, fw)
        ends = span(u, 0.3, su - 0.3, fw)
        return min(1.0, (mark + edge) * ends)
    if kind == 2:
        return pulse(v - 0.25, 1.0, 0.5, fw) * span(u, 0.2, su - 0.2, fw)
    if kind == 3:
        lane = span(v, 0.1, 5.0, fw) + span(v, sv - 5.0, sv - 0.1, fw)
        line = span(v, 5.0, 5.12, fw) + span(v, sv - 5.12, sv - 5.0, fw)
        return min(1.0, lane * pulse(u, 2.6, 0.12, fw) + line)
    return 0.0


@njit(cache=True)
def _paving(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Slabs. Numbers: length, height, bond shift, pattern (0 plain, 1 bands, 2 rings), scale."""
    c0, c1, c2 = _colors(s)
    length, height = s[10], s[11]
    row = math.floor(v / height)
    shifted = u + s[12] * length * (row & 1)
    col = math.floor(shifted / length)
    light = 0.0
    if s[13] == 1.0:
        light = max(pulse(u, s[14], 0.18 * s[14], fw), pulse(v, s[14], 0.18 * s[14], fw))
    elif s[13] == 2.0:
        du, dv = u - 0.5 * su, v - 0.5 * sv
        r = math.sqrt(du * du + dv * dv) + 1e-6
        turn = math.atan2(dv, du) / (2.0 * math.pi)
        spokes = pulse(turn, 1.0 / 12.0, 0.02, fw / (2.0 * math.pi * r))
        light = max(pulse(r, s[14], 0.28 * s[14], fw), spokes * smooth(2.0, 4.0, r))
    color = mix(c0, c1, light)
    near = fade(min(length, height), fw)
    color = scaled(color, 1.0 + 0.42 * near * (hash01(col, row, seed) - 0.5))
    group = hash01(math.floor(u / 2.7), math.floor(v / 2.3), seed + 8)
    color = scaled(color, 0.94 + 0.12 * group)
    joint = max(pulse(v, height, 0.025, fw), pulse(shifted, length, 0.025, fw))
    color = mix(color, c2, 0.75 * joint)
    spot = smooth(0.35, 0.55, fbm(u, v, 1.4, 5, seed + 2, fw))
    color = scaled(color, 1.0 - 0.3 * spot)
    return scaled(color, 1.0 + 0.2 * fbm(u, v, 4.5, 4, seed + 1, fw))


@njit(cache=True)
def _grass(s, x, y, seed, fw):  # type: ignore[no-untyped-def]
    """Meadow in world axes; c0 and c1 grass, c2 bare soil. Numbers: wear, litter, stripes."""
    c0, c1, c2 = _colors(s)
    broad = fbm(x, y, 6.0, 5, seed, fw)
    color = mix(c0, c1, smooth(-0.55, 0.55, broad))
    tuft = fbm(x, y, 0.55, 4, seed + 1, fw)
    color = scaled(color, max(0.3, 1.0 + 0.55 * tuft))
    if s[12] > 0.0:
        color = scaled(color, 1.0 + s[12] * (pulse(x + 0.3 * y, 3.0, 1.5, fw) - 0.5))
    bare = smooth(0.62 - s[10], 0.85 - s[10], fbm(x, y, 3.1, 5, seed + 2, fw) + 0.25)
    color = mix(color, scaled(c2, 1.0 + 0.4 * tuft), 0.85 * bare)
    ix, iy = math.floor(x / 0.35), math.floor(y / 0.35)
    pick = hash01(ix, iy, seed + 3)
    cluster = 0.5 + 0.5 * fbm(x, y, 2.2, 3, seed + 4, fw)
    litter = lottery(pick, s[11] * cluster, fade(0.3, 0.7 * fw))  # fallen leaves, or flowers
    leaf = (0.36, 0.15, 0.03) if hash01(ix, iy, seed + 5) < 0.6 else (0.45, 0.29, 0.05)
    leaf = mix((0.396, 0.206, 0.038), leaf, fade(0.3, 0.7 * fw))
    color = mix(color, leaf, 0.85 * litter)
    return color


@njit(cache=True)
def _soil(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Bare ground with stones and ruts. Numbers: stones, ruts."""
    c0, c1, c2 = _colors(s)
    color = mix(c0, c1, smooth(-0.5, 0.5, fbm(u, v, 4.0, 6, seed, fw)))
    color = scaled(color, 1.0 + 0.4 * fbm(u, v, 0.5, 3, seed + 1, fw))
    ix, iy = math.floor(u / 0.3), math.floor(v / 0.3)
    seen = fade(0.3, 0.7 * fw)
    stone = scaled(c2, 1.0 + 0.8 * seen * (hash01(ix, iy, seed + 3) - 0.5))
    color = mix(color, stone, lottery(hash01(ix, iy, seed + 2), s[10], seen))
    wave = v + 0.8 * fbm(u, 0.3 * v, 9.0, 2, seed + 4, fw)
    rut = pulse(wave, 6.5, 0.45, fw) + pulse(wave - 1.8, 6.5, 0.45, fw)
    return scaled(color, 1.0 - s[11] * 0.4 * rut)


@njit(cache=True)
def _leaves(s, x, y, z, seed, fw):  # type: ignore[no-untyped-def]
    """Foliage: cells of leaf size in clumps of light and dark. Numbers: leaf size, accents."""
    c0, c1, c2 = _colors(s)
    size = s[10]
    near, middle = fade(size, 0.8 * fw), fade(4.0 * size, fw)
    # Cells lie askew and are shaken by noise, so that no rows of leaves show.
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


@njit(cache=True)
def _wood(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Boards along u. Numbers: board width, gap."""
    c0, c1, _ = _colors(s)
    board = math.floor(v / s[10])
    color = mix(c0, c1, 0.3 + 0.5 * hash01(board, 0, seed))
    color = scaled(color, 1.0 + 0.35 * fbm(u * 0.4, v * 5.0, 0.5, 3, seed + 1, fw))
    return scaled(color, 1.0 - 0.75 * pulse(v, s[10], s[11], fw))


@njit(cache=True)
def _paint(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Smooth paint with darker edges and dust; c1 is a stripe. Numbers: dust, stripe share."""
    c0, c1, c2 = _colors(s)
    edge = min(min(u, su - u), min(v, sv - v))
    color = scaled(c0, 0.8 + 0.2 * smooth(0.0, 0.12, edge))
    if s[11] > 0.0:
        color = mix(color, c1, span(v / sv, 0.5 - 0.5 * s[11], 0.5 + 0.5 * s[11], fw / sv))
    dust = s[10] * (0.5 + 0.6 * fbm(u, v, 0.8, 4, seed, fw))
    return mix(color, c2, min(1.0, max(0.0, dust)))


@njit(cache=True)
def _corrugated(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Sheet metal with ribs, rust (c1) and a lettered band (c2). Numbers: pitch, rust, band."""
    c0, c1, c2 = _colors(s)
    rib = pulse(u, s[10], 0.5 * s[10], fw) - 0.5
    color = scaled(c0, 1.0 + 0.5 * rib)
    if s[12] > 0.0:
        iu = math.floor(u / 0.45)
        letter = span(v, 0.45 * sv, 0.7 * sv, fw) * pulse(u, 0.45, 0.3, fw)
        inside = span(u, 0.2 * su, 0.75 * su, fw)
        there = lottery(hash01(iu, 3, seed), 0.8, fade(0.3, 0.7 * fw))
        color = mix(color, c2, letter * inside * there)
    rust = smooth(0.55 - s[11], 0.8 - s[11], fbm(u * 1.5, v * 0.6, 1.0, 4, seed + 1, fw) + 0.2)
    return _weather(mix(color, c1, 0.8 * rust), u, v, seed, fw, 0.15)


@njit(cache=True)
def _fields(s, x, y, seed, fw):  # type: ignore[no-untyped-def]
    """Countryside in world axes: parcels with furrows, hedges, woods. Numbers: litness."""
    c0, c1, c2 = _colors(s)
    wx = x + 9.0 * fbm(x, y, 60.0, 2, seed + 1, 0.01)
    wy = y + 9.0 * fbm(y, x, 60.0, 2, seed + 2, 0.01)
    row = math.floor(wy / 58.0)
    shifted = wx + 37.0 * hash01(row, 5, seed)
    col = math.floor(shifted / 83.0)
    pick, tone = hash01(col, row, seed + 3), hash01(col, row, seed + 4)
    color = mix(c0, c1, pick)
    if tone > 0.7:
        color = mix(color, c2, 0.8)
    angle = 6.28 * hash01(col, row, seed + 6)
    across = x * math.cos(angle) + y * math.sin(angle)
    furrow = pulse(across, 3.2, 1.5, fw) - 0.47
    color = scaled(color, 1.0 + 0.35 * furrow)
    color = scaled(color, max(0.4, 1.0 + 0.42 * fbm(x, y, 14.0, 6, seed + 7, fw)))
    hedge = max(pulse(shifted + 1.2, 83.0, 2.4, fw), pulse(wy + 1.2, 58.0, 2.4, fw))
    color = mix(color, scaled(c0, 0.35), 0.85 * hedge)
    wood = smooth(0.18, 0.26, fbm(x, y, 120.0, 4, seed + 8, fw))
    dark = scaled(c0, max(0.15, 0.42 + 0.35 * fbm(x, y, 5.0, 4, seed + 9, fw)))
    return mix(color, dark, wood)


@njit(cache=True)
def _glass(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Window: frame c0, room c1, curtain c2. Numbers: frame width, panes across, panes up."""
    c0, c1, c2 = _colors(s)
    f = s[10]
    inside = span(u, f, su - f, fw) * span(v, f, sv - f, fw)
    cu, cv = su / max(s[11], 1.0), sv / max(s[12], 1.0)
    bars = max(pulse(u + 0.5 * f, cu, f, fw), pulse(v + 0.5 * f, cv, f, fw))
    room = scaled(c1, 0.5 + 0.9 * hash01(1, 0, seed) + 0.5 * (1.0 - v / sv))
    kind = hash01(2, 0, seed)
    if kind < 0.3:  # blind from the top
        low = sv * (0.25 + 0.6 * hash01(3, 0, seed))
        slat = 0.85 + 0.3 * (pulse(v, 0.12, 0.08, fw) - 0.6)
        room = mix(room, scaled(c2, slat), span(v, low, sv, fw))
    elif kind < 0.75:  # curtains at both sides
        w = su * (0.12 + 0.22 * hash01(4, 0, seed))
        fold = 0.75 + 0.35 * pulse(u, 0.19, 0.1, fw)
        side = span(u, 0.0, w, fw) + span(u, su - w, su, fw)
        room = mix(room, scaled(c2, fold), 0.9 * min(1.0, side))
    return mix(c0, room, max(0.0, inside - bars))


@njit(cache=True)
def _sign(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Board c0 with letters c1 made of random strokes, border c2."""
    c0, c1, c2 = _colors(s)
    height = 0.56 * sv
    pitch = 0.72 * height
    first = 0.12 * su
    count = int((0.76 * su) / pitch)
    color = c0
    if pitch > 1e-6 and count > 0:
        i = math.floor((u - first) / pitch)
        if 0 <= i < count and hash01(i, 9, seed) < 0.88:
            a = (u - first) / pitch - i
            b = (v - 0.22 * sv) / height
            w = fw / height
            ink = 0.0
            for stroke in range(5):
                h = hash01(i, stroke, seed)
                at = 0.12 + 0.33 * (stroke % 3)
                if h < 0.6:
                    if stroke < 3:
                        ink = max(
                            ink,
                            span(b, at * 1.25 - 0.07, at * 1.25 + 0.07, w) * span(a, 0.1, 0.8, w),
                        )
                    else:
                        side = 0.12 + 0.56 * (stroke - 3)
                        ink = max(ink, span(a, side - 0.07, side + 0.07, w) * span(b, 0.0, 1.0, w))
            seen = fade(0.25 * height, 0.5 * fw)
            color = mix(color, c1, seen * ink + (1.0 - seen) * 0.25 * span(b, 0.0, 1.0, w))
    border = 1.0 - span(u, 0.05, su - 0.05, fw) * span(v, 0.05, sv - 0.05, fw)
    return mix(color, c2, min(1.0, max(0.0, border)))


@njit(cache=True)
def _water(s, x, y, seed, fw):  # type: ignore[no-untyped-def]
    c0, c1, _ = _colors(s)
    return mix(c0, c1, smooth(-0.4, 0.6, fbm(x, y, 0.9, 4, seed, fw)))


@njit(cache=True)
def _solar(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    c0, c1, c2 = _colors(s)
    color = mix(c0, c1, max(pulse(u, 0.16, 0.02, fw), pulse(v, 0.16, 0.02, fw)))
    return mix(color, c2, max(pulse(u + 0.02, 1.0, 0.05, fw), pulse(v + 0.02, 1.6, 0.05, fw)))


@njit(cache=True)
def _door(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Door leaf c0 with sunk panels, glass c1 above, frame c2."""
    c0, c1, c2 = _colors(s)
    panel = pulse(u - 0.15, 0.5 * su, 0.5 * su - 0.3, fw) * pulse(v - 0.2, 0.9, 0.6, fw)
    color = scaled(c0, (1.0 - 0.3 * panel) * (1.0 + 0.15 * fbm(u, v, 0.7, 3, seed, fw)))
    color = mix(color, c1, span(v, 0.82 * sv, 0.95 * sv, fw) * span(u, 0.15, su - 0.15, fw))
    border = 1.0 - span(u, 0.09, su - 0.09, fw) * span(v, -1.0, sv - 0.09, fw)
    return mix(color, c2, min(1.0, max(0.0, border)))


@njit(cache=True)
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
        c = _plaster(s, u, v, seed, fw)
    elif kind == BRICK:
        c = _brick(s, u, v, seed, fw)
    elif kind == PANEL:
        c = _panel(s, u, v, seed, fw)
    elif kind == CONCRETE:
        c = _concrete(s, u, v, seed, fw)
    elif kind == TILES:
        c = _tiles(s, u, v, seed, fw)
    elif kind == FLAT_ROOF:
        c = _flat_roof(s, u, v, su, sv, seed, fw)
    elif kind == ASPHALT:
        c = _asphalt(s, u, v, su, sv, seed, fw)
    elif kind == PAVING:
        c = _paving(s, u, v, su, sv, seed, fw)
    elif kind == GRASS:
        c = _grass(s, x, y, seed, fw)
    elif kind == SOIL:
        c = _soil(s, u, v, seed, fw)
    elif kind == LEAVES:
        c = _leaves(s, x, y, z, seed, fw)
    elif kind == WOOD:
        c = _wood(s, u, v, seed, fw)
    elif kind == PAINT:
        c = _paint(s, u, v, su, sv, seed, fw)
    elif kind == CORRUGATED:
        c = _corrugated(s, u, v, su, sv, seed, fw)
    elif kind == FIELDS:
        c = _fields(s, x, y, seed, fw)
    elif kind == GLASS:
        c = _glass(s, u, v, su, sv, seed, fw)
    elif kind == SIGN:
        c = _sign(s, u, v, su, sv, seed, fw)
    elif kind == WATER:
        c = _water(s, x, y, seed, fw)
    elif kind == SOLAR:
        c = _solar(s, u, v, seed, fw)
    elif kind == DOOR:
        c = _door(s, u, v, su, sv, seed, fw)
    else:
        c = _plain(s, u, v, seed, fw)
    return (
        min(0.92, max(0.004, c[0])),
        min(0.92, max(0.004, c[1])),
        min(0.92, max(0.004, c[2])),
    )
