"""Indirect light: radiance of low order on a grid, from rays that the grid's points send out.

The light of a place is then a smooth function of position and direction: equal for all views, and
without the noise that rays per pixel would have.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.synth.render.geometry_tables import MISS
from chronoscene.synth.render.light import sky_radiance

Array = NDArray[np.float64]


class Probes(NamedTuple):
    """Indirect light on a grid: radiance of order 1 in spherical harmonics."""

    origin: Array
    step: Array
    """[3]"""
    values: NDArray[np.float32]
    """Mean radiance and three slopes per colour. [X, Y, Z, 4, 3]"""
    valid: NDArray[np.float32]
    """0 inside of objects. [X, Y, Z]"""


@inner
def probe_light(probes, x, y, z, dx, dy, dz, slope):  # type: ignore[no-untyped-def]
    """Indirect radiance around a point for a direction; ``slope`` 2/3 gives diffuse light."""
    nx, ny, nz = probes.valid.shape
    fx = min(max((x - probes.origin[0]) / probes.step[0], 0.0), nx - 1.001)
    fy = min(max((y - probes.origin[1]) / probes.step[1], 0.0), ny - 1.001)
    fz = min(max((z - probes.origin[2]) / probes.step[2], 0.0), nz - 1.001)
    ix, iy, iz = int(fx), int(fy), int(fz)
    r, g, b, total = 0.0, 0.0, 0.0, 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        wx = fx - ix if i else 1.0 - fx + ix
        wy = fy - iy if j else 1.0 - fy + iy
        wz = fz - iz if k else 1.0 - fz + iz
        w = (wx * wy * wz + 1e-4) * probes.valid[ix + i, iy + j, iz + k]
        p = probes.values[ix + i, iy + j, iz + k]
        r += w * max(0.0, p[0, 0] + slope * (p[1, 0] * dx + p[2, 0] * dy + p[3, 0] * dz))
        g += w * max(0.0, p[0, 1] + slope * (p[1, 1] * dx + p[2, 1] * dy + p[3, 1] * dz))
        b += w * max(0.0, p[0, 2] + slope * (p[1, 2] * dx + p[2, 2] * dy + p[3, 2] * dz))
        total += w
    inverse = 1.0 / max(total, 1e-9)
    return r * inverse, g * inverse, b * inverse


@kernel(parallel=True)
def probe_values(  # type: ignore[no-untyped-def]
    rays, t, tri, uv, lit, tables, mean_albedo, sky, count
):
    """Radiance of order 1 around each probe from the rays that it sent.

    Hits get sun and a constant sky; a probe that mostly sees backs of surfaces is inside.

    Returns:
        values: [P, 4, 3] float32
        valid: [P] float32
    """
    number = len(t) // count
    values = np.zeros((number, 4, 3), np.float32)
    valid = np.ones(number, np.float32)
    for p in prange(number):
        acc = np.zeros((4, 3))
        backs = 0
        for i in range(p * count, (p + 1) * count):
            dx, dy, dz = float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5])
            if tri[i] == MISS:
                c = sky_radiance(dx, dy, dz, sky, False)
            else:
                n = tables.normals[tri[i], 0]
                style = tables.patch_style[tables.tri_patch[tri[i]]]
                solid = tables.styles[style, 22] <= 0.0
                if solid and n[0] * dx + n[1] * dy + n[2] * dz > 0.0:
                    backs += 1
                    continue
                d = sky.direction
                facing = max(0.0, n[0] * d[0] + n[1] * d[1] + n[2] * d[2])
                sun = facing if lit[i] else 0.0
                m = mean_albedo[style]
                c = (
                    m[0] * (sun * sky.sun[0] + 0.4 * sky.horizon[0]),
                    m[1] * (sun * sky.sun[1] + 0.4 * sky.horizon[1]),
                    m[2] * (sun * sky.sun[2] + 0.4 * sky.horizon[2]),
                )
            for k in range(3):
                acc[0, k] += c[k]
                acc[1, k] += 3.0 * dx * c[k]
                acc[2, k] += 3.0 * dy * c[k]
                acc[3, k] += 3.0 * dz * c[k]
        seen = max(1, count - backs)
        if backs > 0.25 * count:
            valid[p] = 0.0
        for j in range(4):
            for k in range(3):
                values[p, j, k] = acc[j, k] / seen
    return values, valid
