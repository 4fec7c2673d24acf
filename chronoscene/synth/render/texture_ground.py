"""Textures of roads, squares, lawns, fields, foliage and roofs; see `textures`."""

from __future__ import annotations

import math

from chronoscene.kernels.compilation import inner
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
    span,
    value_noise_3d,
    weather,
)


@inner
def flat_roof(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Bitumen sheets or gravel. Numbers: sheet width, gravel (0 or 1)."""
    c0, c1, c2 = colors(s)
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
    return weather(color, u, v, seed, fw, 0.25)


@inner
def tiles(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Roof tiles, v up the slope; c0 and c1 tiles, c2 moss. Numbers: width, height, moss."""
    c0, c1, c2 = colors(s)
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


@inner
def asphalt(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Road, u along it. Numbers: marking (0 none, 1 lanes, 2 zebra, 3 parking lot), parking."""
    c0, c1, paint = colors(s)
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


@inner
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


@inner
def paving(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Slabs. Numbers: length, height, bond shift, pattern (0 plain, 1 bands, 2 rings), scale."""
    c0, c1, c2 = colors(s)
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


@inner
def grass(s, x, y, seed, fw):  # type: ignore[no-untyped-def]
    """Meadow in world axes; c0 and c1 grass, c2 bare soil. Numbers: wear, litter, stripes."""
    c0, c1, c2 = colors(s)
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


@inner
def soil(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Bare ground with stones and ruts. Numbers: stones, ruts."""
    c0, c1, c2 = colors(s)
    color = mix(c0, c1, smooth(-0.5, 0.5, fbm(u, v, 4.0, 6, seed, fw)))
    color = scaled(color, 1.0 + 0.4 * fbm(u, v, 0.5, 3, seed + 1, fw))
    ix, iy = math.floor(u / 0.3), math.floor(v / 0.3)
    seen = fade(0.3, 0.7 * fw)
    stone = scaled(c2, 1.0 + 0.8 * seen * (hash01(ix, iy, seed + 3) - 0.5))
    color = mix(color, stone, lottery(hash01(ix, iy, seed + 2), s[10], seen))
    wave = v + 0.8 * fbm(u, 0.3 * v, 9.0, 2, seed + 4, fw)
    rut = pulse(wave, 6.5, 0.45, fw) + pulse(wave - 1.8, 6.5, 0.45, fw)
    return scaled(color, 1.0 - s[11] * 0.4 * rut)


@inner
def fields(s, x, y, seed, fw):  # type: ignore[no-untyped-def]
    """Countryside in world axes: parcels with furrows, hedges, woods."""
    c0, c1, c2 = colors(s)
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


@inner
def water(s, x, y, seed, fw):  # type: ignore[no-untyped-def]
    c0, c1, _ = colors(s)
    return mix(c0, c1, smooth(-0.4, 0.6, fbm(x, y, 0.9, 4, seed, fw)))


@inner
def leaves(s, x, y, z, seed, fw):  # type: ignore[no-untyped-def]
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
