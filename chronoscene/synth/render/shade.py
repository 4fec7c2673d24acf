"""Compiled shading: camera rays, hit points, light, tone curve.

All parallel loops run over independent pixels or samples, so the result does not depend on the
number of threads.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.synth.render.light import probe_light, sky_radiance
from chronoscene.synth.render.mesh import MISS, hit_normals
from chronoscene.synth.render.noise import dot, mix, plus, scaled, times
from chronoscene.synth.render.textures import albedo


@kernel(parallel=True)
def camera_rays(world_from_cam, k, width, row0, rows, ss):  # type: ignore[no-untyped-def]
    """Rays with unit z in the camera, so that the hit parameter is z-depth. [n, 6]

    Samples of a pixel are neighbours: index ((row * width + column) * ss + j) * ss + i.
    """
    rays = np.empty((rows * width * ss * ss, 6), np.float32)
    for pixel in prange(rows * width):
        row, column = row0 + pixel // width, pixel % width
        for j in range(ss):
            for i in range(ss):
                x = (column + (i + 0.5) / ss - k[0, 2]) / k[0, 0]
                y = (row + (j + 0.5) / ss - k[1, 2]) / k[1, 1]
                n = (pixel * ss + j) * ss + i
                for axis in range(3):
                    m = world_from_cam[axis]
                    rays[n, axis] = m[3]
                    rays[n, 3 + axis] = m[0] * x + m[1] * y + m[2]
    return rays


@kernel(parallel=True)
def shadow_rays(rays, t, tri, uv, tables, direction, spread, count):  # type: ignore[no-untyped-def]
    """Rays to the sun for all samples, and whether each is needed. [n, 6], [n]

    Sample i uses direction ``i % count`` of the sun's disc: the offsets are fixed in the world, so
    views agree on the soft edges of shadows.
    """
    n = len(t)
    out = np.zeros((n, 6), np.float32)
    need = np.zeros(n, np.bool_)
    for i in prange(n):
        if tri[i] == MISS:
            continue
        r = rays[i]
        normal, _ = hit_normals(tables, tri[i], uv[i, 0], uv[i, 1], r[3:])
        turn = 2.399963 * (i % count)
        radius = spread * math.sqrt((i % count + 0.5) / count)
        # Two axes across the sun's direction; the sun is never in the zenith.
        ax, ay = -direction[1], direction[0]
        norm = math.sqrt(ax * ax + ay * ay)
        ax, ay = ax / norm, ay / norm
        bx, by, bz = -direction[2] * ay, direction[2] * ax, direction[0] * ay - direction[1] * ax
        ca, sa = radius * math.cos(turn), radius * math.sin(turn)
        lx = direction[0] + ca * ax + sa * bx
        ly = direction[1] + ca * ay + sa * by
        lz = direction[2] + sa * bz
        facing = dot(normal, (lx, ly, lz))
        style = tables.styles[tables.patch_style[tables.tri_patch[tri[i]]]]
        if facing <= 0.0 and style[22] <= 0.0:
            continue
        need[i] = True
        eps = 2e-3 + 2e-5 * t[i]
        side = eps if facing > 0.0 else -eps
        for axis in range(3):
            out[i, axis] = r[axis] + t[i] * r[3 + axis] + side * normal[axis]
        out[i, 3], out[i, 4], out[i, 5] = lx, ly, lz
    return out, need


@inner
def surface_albedo(tables, tri, x, y, z, fw):  # type: ignore[no-untyped-def]
    """Texture of a triangle at a world point seen with pixels of width ``fw``."""
    patch = tables.tri_patch[tri]
    p = tables.patches[patch]
    dx, dy, dz = x - p[0], y - p[1], z - p[2]
    u = dx * p[3] + dy * p[4] + dz * p[5]
    v = dx * p[6] + dy * p[7] + dz * p[8]
    style = tables.styles[tables.patch_style[patch]]
    return albedo(style, u, v, x, y, z, p[9], p[10], tables.patch_seed[patch], fw)


@inner
def _reflected(p, n, d, style, facing, lit, sky, probes):  # type: ignore[no-untyped-def]
    """Specular reflection of sky and surroundings, and the sun's highlight."""
    k = 2.0 * dot(d, n)
    m = (d[0] - k * n[0], d[1] - k * n[1], d[2] - k * n[2])
    grazing = (1.0 - min(1.0, abs(0.5 * k))) ** 5
    strength = style[20] + (1.0 - style[20]) * grazing * 0.6 * style[21]
    color = probe_light(probes, p, m, 1.0)
    if m[2] > 0.0:
        color = scaled(plus(color, sky_radiance(m, sky, False)), 0.5)
    towards = dot(m, sky.direction)
    if facing > 0.0 and towards > 0.0:
        spot = lit * 3.0 * towards ** (20.0 + 180.0 * style[21])
        color = plus(color, scaled(sky.sun, spot))
    return scaled(color, strength), strength


@inner
def _direction(ray):  # type: ignore[no-untyped-def]
    """Direction of a ray as float64, and its length."""
    d = (float(ray[3]), float(ray[4]), float(ray[5]))
    return d, math.sqrt(dot(d, d))


@inner
def _base(ray, t, tri, u, v, tables, fw_unit):  # type: ignore[no-untyped-def]
    """Albedo of a hit for samples of the given width at unit distance."""
    d, length = _direction(ray)
    normal, _ = hit_normals(tables, tri, u, v, d)
    slant = max(0.25, abs(dot(normal, d)) / length)
    fw = max(1e-4, fw_unit * t * length / math.sqrt(slant))
    x, y, z = plus(ray, scaled(d, t))
    return surface_albedo(tables, tri, x, y, z, fw)


@inner
def _radiance(ray, t, tri, u, v, lit, base, tables, sky, probes):  # type: ignore[no-untyped-def]
    """Radiance along a ray that hit a surface of albedo ``base``; ``lit`` is 0..1."""
    step, length = _direction(ray)
    d = (step[0] / length, step[1] / length, step[2] / length)
    g, s = hit_normals(tables, tri, u, v, step)
    style = tables.styles[tables.patch_style[tables.tri_patch[tri]]]
    through = style[22]
    if through <= 0.0 and dot(s, g) < 0.0:
        s = scaled(s, -1.0)  # the back of an open sheet
    facing, flat = dot(s, sky.direction), dot(g, sky.direction)
    if through > 0.0:
        # Leaves scatter forward as well: light wraps around the crown.
        direct = lit * max(0.0, (facing + through) / (1.0 + through))
    else:
        direct = lit * max(0.0, facing) if flat > 0.0 else 0.0
    outside = plus(plus(ray, scaled(step, t)), scaled(g, 0.8))
    indirect = probe_light(probes, outside, s, 2.0 / 3.0)
    color = times(base, plus(scaled(sky.sun, direct), indirect))
    if style[20] > 0.0:
        mirrored, share = _reflected(outside, g, d, style, flat, lit, sky, probes)
        color = plus(scaled(color, 1.0 - share), mirrored)
    air = math.exp(-sky.haze * t * length)
    haze = sky_radiance((d[0], d[1], 0.02), sky, False)
    return plus(scaled(color, air), scaled(haze, 1.0 - air))


@inner
def _sky(ray, sky):  # type: ignore[no-untyped-def]
    """Radiance of the sky along a ray."""
    d, length = _direction(ray)
    return sky_radiance((d[0] / length, d[1] / length, d[2] / length), sky, True)


@inner
def _share(lit, first, count):  # type: ignore[no-untyped-def]
    """Share of lit samples."""
    total = 0.0
    for i in range(first, first + count):
        total += 1.0 if lit[i] else 0.0
    return total / count


@inner
def _uniform(tri, first, end, tables):  # type: ignore[no-untyped-def]
    """Return True if all samples of a pixel lie on one opaque patch."""
    if tri[first] == MISS:
        return False
    patch = tables.tri_patch[tri[first]]
    if tables.styles[tables.patch_style[patch], 22] > 0.0:
        return False
    for i in range(first + 1, end):
        if tri[i] == MISS or tables.tri_patch[tri[i]] != patch:
            return False
    return True


@inner
def _tone(x):  # type: ignore[no-untyped-def]
    """Filmic curve (a rational fit with toe and shoulder), then the sRGB transfer function."""
    x = max(0.0, x)
    y = x * (2.2 * x + 0.08) / (x * (2.1 * x + 0.95) + 0.20)
    y = min(1.0, y)
    return 12.92 * y if y <= 0.0031308 else 1.055 * y ** (1.0 / 2.4) - 0.055


@kernel(parallel=True)
def shade(rays, t, tri, uv, lit, tables, sky, probes, per_pixel, fw_unit):  # type: ignore[no-untyped-def]
    """Displayed colours of pixels. [pixels, 3] uint8

    Args:
        rays: [n, 6]; the samples of a pixel follow each other.
        t: Hit parameters. [n]
        tri: Triangles, or `MISS`. [n]
        uv: Barycentric coordinates. [n, 2]
        lit: Whether the sun reaches the sample. [n]
        tables: Geometry and styles.
        sky: Light settings.
        probes: Indirect light.
        per_pixel: Samples per pixel.
        fw_unit: Width of a sample's footprint at unit distance.
    """
    out = np.empty((len(t) // per_pixel, 3), np.uint8)
    for pixel in prange(len(out)):
        color = (0.0, 0.0, 0.0)
        first, count, stride, wide = pixel * per_pixel, per_pixel, 1, fw_unit
        uniform = per_pixel > 1 and _uniform(tri, first, first + per_pixel, tables)
        old = (0.0, 0.0, 0.0)
        if uniform:
            # Textures are filtered, so two samples on a diagonal are enough on one patch.
            count, stride, wide = 2, per_pixel - 1, fw_unit * math.sqrt(0.5 * per_pixel)
        for k in range(count):
            i = first + k * stride
            u, v, sun = float(uv[i, 0]), float(uv[i, 1]), 1.0 if lit[i] else 0.0
            if tri[i] == MISS:
                c = _sky(rays[i], sky)
            else:
                base = _base(rays[i], float(t[i]), tri[i], u, v, tables, wide)
                if uniform and k == 0:
                    old = base
                    continue
                if uniform:
                    base = mix(old, base, 0.5)
                    sun = _share(lit, first, per_pixel)
                c = _radiance(rays[i], float(t[i]), tri[i], u, v, sun, base, tables, sky, probes)
            # The cap keeps a single bright sample from whitening an edge.
            weight = per_pixel if uniform else 1
            color = plus(color, scaled((min(c[0], 6.0), min(c[1], 6.0), min(c[2], 6.0)), weight))
        gain = sky.exposure / per_pixel
        for k in range(3):
            out[pixel, k] = int(255.0 * _tone(color[k] * gain * sky.white[k]) + 0.5)
    return out


@kernel(parallel=True)
def albedo_at(points, tri, tables, fw):  # type: ignore[no-untyped-def]
    """Albedo of hit points at given pixel widths; zero where nothing was hit. [n, 3]"""
    out = np.zeros((len(points), 3))
    for i in prange(len(points)):
        if tri[i] != MISS:
            x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
            out[i] = surface_albedo(tables, tri[i], x, y, z, max(1e-4, fw[i]))
    return out
