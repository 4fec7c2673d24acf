"""Random numbers: seeded generators for the layout, hashes and noise for textures.

Generators are keyed by names, so that adding an object leaves the others unchanged. The
compiled functions are pure. Those that draw detail take ``fw``, the width of a pixel on the
surface in metres, and fade or average what is smaller, so that textures do not alias.
"""

from __future__ import annotations

import math
import zlib

import numpy as np

from chronoscene.kernels.compilation import inner

MASK = 0xFFFFFFFF


def rng_for(seed: int, *keys: object) -> np.random.Generator:
    """Generator for a named purpose; the same seed and keys give the same numbers anywhere."""
    words = [zlib.crc32(str(key).encode()) for key in keys]
    return np.random.default_rng(np.random.SeedSequence([seed, *words]))


def key_number(*keys: object) -> int:
    """Small non-negative integer derived from a name, for the hashes in textures."""
    return zlib.crc32("/".join(map(str, keys)).encode()) % 65_521


@inner
def hash01(ix, iy, seed):  # type: ignore[no-untyped-def]
    """Pseudo-random number, uniform in 0..1, from two integers and a seed."""
    h = (ix * 0x9E3779B1 + iy * 0x85EBCA77 + seed * 0xC2B2AE3D) & MASK
    h ^= h >> 15
    h = (h * 0x2C1B3C6D) & MASK
    h ^= h >> 12
    h = (h * 0x297A2D39) & MASK
    h ^= h >> 15
    return h / 4294967296.0


@inner
def value_noise(x, y, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in -1..1 with features of size 1."""
    ix, iy = math.floor(x), math.floor(y)
    fx, fy = x - ix, y - iy
    sx = fx * fx * fx * (fx * (fx * 6.0 - 15.0) + 10.0)
    sy = fy * fy * fy * (fy * (fy * 6.0 - 15.0) + 10.0)
    a, b = hash01(ix, iy, seed), hash01(ix + 1, iy, seed)
    c, d = hash01(ix, iy + 1, seed), hash01(ix + 1, iy + 1, seed)
    return 2.0 * (a + (b - a) * sx + (c - a) * sy + (a - b - c + d) * sx * sy) - 1.0


@inner
def value_noise_3d(x, y, z, seed):  # type: ignore[no-untyped-def]
    """Smooth noise in -1..1 of a point in space with features of size 1."""
    iz = math.floor(z)
    t = z - iz
    t = t * t * (3.0 - 2.0 * t)
    low = value_noise(x, y, seed + 1013 * iz)
    return low + t * (value_noise(x, y, seed + 1013 * (iz + 1)) - low)


@inner
def fade(size, fw):  # type: ignore[no-untyped-def]
    """Weight 0..1 of detail of the given size, seen with pixels of width ``fw``."""
    return min(1.0, max(0.0, size / fw * 0.8 - 0.6))


@inner
def fbm(x, y, size, octaves, seed, fw):  # type: ignore[no-untyped-def]
    """Sum of octaves of value noise, about -1..1; the largest features have ``size`` metres."""
    total, amplitude = 0.0, 0.55
    for octave in range(octaves):
        weight = fade(size, fw)
        if weight <= 0.0:
            break
        total += amplitude * weight * value_noise(x / size, y / size, seed + 131 * octave)
        # Rotating between octaves hides the lattice of the noise.
        x, y = 0.8 * x - 0.6 * y, 0.6 * x + 0.8 * y
        size *= 0.47
        amplitude *= 0.55
    return total


@inner
def pulse(x, period, width, fw):  # type: ignore[no-untyped-def]
    """Share of a pixel around x that lies in [0, width) modulo period: an exact box filter."""
    a, b = (x - 0.5 * fw) / period, (x + 0.5 * fw) / period
    duty = width / period
    fa, fb = math.floor(a), math.floor(b)
    return (fb * duty + min(b - fb, duty) - fa * duty - min(a - fa, duty)) / (b - a)


@inner
def span(x, low, high, fw):  # type: ignore[no-untyped-def]
    """Share of a pixel around x that lies in low..high."""
    a, b = max(low, x - 0.5 * fw), min(high, x + 0.5 * fw)
    return max(0.0, b - a) / fw


@inner
def smooth(low, high, x):  # type: ignore[no-untyped-def]
    """Smooth step from 0 at ``low`` to 1 at ``high``."""
    t = min(1.0, max(0.0, (x - low) / (high - low)))
    return t * t * (3.0 - 2.0 * t)


@inner
def lottery(draw, share, seen):  # type: ignore[no-untyped-def]
    """1 for draws below ``share``, else 0; tends to the mean where cells are too small to see."""
    return (seen if draw < share else 0.0) + (1.0 - seen) * share


@inner
def mix(a, b, t):  # type: ignore[no-untyped-def]
    """Colours between a (t = 0) and b (t = 1)."""
    return (a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t, a[2] + (b[2] - a[2]) * t)


@inner
def scaled(a, f):  # type: ignore[no-untyped-def]
    """Colour or vector times a factor."""
    return (a[0] * f, a[1] * f, a[2] * f)


@inner
def plus(a, b):  # type: ignore[no-untyped-def]
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@inner
def times(a, b):  # type: ignore[no-untyped-def]
    """Products of two colours, channel by channel."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@inner
def dot(a, b):  # type: ignore[no-untyped-def]
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@inner
def unit(a):  # type: ignore[no-untyped-def]
    """A vector scaled to length 1."""
    return scaled(a, 1.0 / max(1e-12, math.sqrt(dot(a, a))))


@inner
def colors(s):  # type: ignore[no-untyped-def]
    return (s[1], s[2], s[3]), (s[4], s[5], s[6]), (s[7], s[8], s[9])


@inner
def weather(color, u, v, seed, fw, strength):  # type: ignore[no-untyped-def]
    """Blotches and vertical streaks, which keep walls from looking flat."""
    blotch = fbm(u, v, 2.6, 5, seed + 11, fw)
    streak = fbm(u * 3.0, v * 0.35, 1.0, 3, seed + 12, 0.6 * fw)
    return scaled(color, max(0.25, 1.0 + strength * (0.75 * blotch + 0.45 * streak)))
