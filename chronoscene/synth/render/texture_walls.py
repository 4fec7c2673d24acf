"""Textures of walls, openings, signs, wood, paint and solar panels; see `textures`."""

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
    weather,
)


@inner
def plain(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Noise only. Numbers: strength, size."""
    c0, c1, _ = colors(s)
    n = fbm(u, v, max(s[11], 0.05), 4, seed, fw)
    return scaled(mix(c0, c1, smooth(-0.5, 0.6, n)), max(0.2, 1.0 + s[10] * n))


@inner
def plaster(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Plaster with a dirty base (c2) and worn spots (c1). Numbers: wear, storey, rows."""
    c0, c1, c2 = colors(s)
    color = weather(c0, u, v, seed, fw, 0.22)
    worn = smooth(0.72 - 0.4 * s[10], 0.84 - 0.4 * s[10], fbm(u, v, 1.3, 5, seed + 21, fw) + 0.25)
    color = mix(color, c1, 0.6 * worn)
    base = math.exp(-max(v, 0.0) / 0.5) * (0.8 + 0.5 * fbm(u, v, 0.9, 3, seed + 22, fw))
    color = mix(color, c2, min(0.55, max(0.0, 0.5 * base)))
    if s[11] > 0.0:  # a painted line under each storey
        line = pulse(v - s[12], s[11], 0.16, fw)
        color = mix(color, c2, 0.45 * line)
    return color


@inner
def brick(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Running bond; c0 and c1 bricks, c2 mortar. Numbers: length, height, band period."""
    c0, c1, c2 = colors(s)
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
    return weather(color, u, v, seed, fw, 0.16)


@inner
def panel(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Cladding panels with dark joints (c2). Numbers: width, height, share of c1."""
    c0, c1, c2 = colors(s)
    col, row = math.floor(u / s[10]), math.floor(v / s[11])
    seen = fade(min(s[10], s[11]), fw)
    accent = hash01(0, row // 2, seed + 3) < s[12] or hash01(col, 0, seed + 4) < 0.4 * s[12]
    color = mix(c0, c1, 1.0 if accent else 0.0)
    color = scaled(color, 1.0 + 0.22 * seen * (hash01(col, row, seed) - 0.5))
    joint = max(pulse(u + 0.015, s[10], 0.05, fw), pulse(v + 0.015, s[11], 0.05, fw))
    color = mix(color, c2, joint)
    return weather(color, u, v, seed, fw, 0.12)


@inner
def concrete(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Cast concrete. Numbers: formwork width, height."""
    c0, c1, _ = colors(s)
    col, row = math.floor(u / s[10]), math.floor(v / s[11])
    color = scaled(c0, 1.0 + 0.16 * (hash01(col, row, seed) - 0.5))
    color = mix(color, c1, 0.5 * smooth(0.0, 0.7, fbm(u * 2.0, v * 0.5, 1.3, 4, seed + 2, fw)))
    joint = max(pulse(u + 0.01, s[10], 0.03, fw), pulse(v + 0.01, s[11], 0.03, fw))
    color = scaled(color, 1.0 - 0.45 * joint)
    hole = pulse(u - 0.4 * s[10], s[10], 0.07, fw) * pulse(v - 0.5 * s[11], s[11], 0.07, fw)
    return weather(scaled(color, 1.0 - 0.6 * hole), u, v, seed, fw, 0.2)


@inner
def glass(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Window: frame c0, room c1, curtain c2. Numbers: frame width, panes across, panes up."""
    c0, c1, c2 = colors(s)
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


@inner
def sign(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Board c0 with letters c1 made of random strokes, border c2."""
    c0, c1, c2 = colors(s)
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


@inner
def door(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Door leaf c0 with sunk panels, glass c1 above, frame c2."""
    c0, c1, c2 = colors(s)
    panel = pulse(u - 0.15, 0.5 * su, 0.5 * su - 0.3, fw) * pulse(v - 0.2, 0.9, 0.6, fw)
    color = scaled(c0, (1.0 - 0.3 * panel) * (1.0 + 0.15 * fbm(u, v, 0.7, 3, seed, fw)))
    color = mix(color, c1, span(v, 0.82 * sv, 0.95 * sv, fw) * span(u, 0.15, su - 0.15, fw))
    border = 1.0 - span(u, 0.09, su - 0.09, fw) * span(v, -1.0, sv - 0.09, fw)
    return mix(color, c2, min(1.0, max(0.0, border)))


@inner
def corrugated(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Sheet metal with ribs, rust (c1) and a lettered band (c2). Numbers: pitch, rust, band."""
    c0, c1, c2 = colors(s)
    rib = pulse(u, s[10], 0.5 * s[10], fw) - 0.5
    color = scaled(c0, 1.0 + 0.5 * rib)
    if s[12] > 0.0:
        iu = math.floor(u / 0.45)
        letter = span(v, 0.45 * sv, 0.7 * sv, fw) * pulse(u, 0.45, 0.3, fw)
        inside = span(u, 0.2 * su, 0.75 * su, fw)
        there = lottery(hash01(iu, 3, seed), 0.8, fade(0.3, 0.7 * fw))
        color = mix(color, c2, letter * inside * there)
    rust = smooth(0.55 - s[11], 0.8 - s[11], fbm(u * 1.5, v * 0.6, 1.0, 4, seed + 1, fw) + 0.2)
    return weather(mix(color, c1, 0.8 * rust), u, v, seed, fw, 0.15)


@inner
def wood(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    """Boards along u. Numbers: board width, gap."""
    c0, c1, _ = colors(s)
    board = math.floor(v / s[10])
    color = mix(c0, c1, 0.3 + 0.5 * hash01(board, 0, seed))
    color = scaled(color, 1.0 + 0.35 * fbm(u * 0.4, v * 5.0, 0.5, 3, seed + 1, fw))
    return scaled(color, 1.0 - 0.75 * pulse(v, s[10], s[11], fw))


@inner
def paint(s, u, v, su, sv, seed, fw):  # type: ignore[no-untyped-def]
    """Smooth paint with darker edges and dust (c2). Numbers: dust."""
    c0, _, c2 = colors(s)
    edge = min(min(u, su - u), min(v, sv - v))
    color = scaled(c0, 0.8 + 0.2 * smooth(0.0, 0.12, edge))
    dust = s[10] * (0.5 + 0.6 * fbm(u, v, 0.8, 4, seed, fw))
    return mix(color, c2, min(1.0, max(0.0, dust)))


@inner
def solar(s, u, v, seed, fw):  # type: ignore[no-untyped-def]
    c0, c1, c2 = colors(s)
    color = mix(c0, c1, max(pulse(u, 0.16, 0.02, fw), pulse(v, 0.16, 0.02, fw)))
    return mix(color, c2, max(pulse(u + 0.02, 1.0, 0.05, fw), pulse(v + 0.02, 1.6, 0.05, fw)))
