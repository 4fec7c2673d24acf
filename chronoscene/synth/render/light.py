"""Light of a period: sun, sky, haze and exposure, the compiled sky, and indirect light.

Indirect light is stored as low-order spherical harmonics on a grid of probes, each of which casts
rays in all directions. It is smooth in position and direction, the same for all views, and free of
the noise that indirect rays per pixel would have.
"""

from __future__ import annotations

import math
from collections import namedtuple
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numba import prange
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.kernels.compilation import inner, kernel
from chronoscene.synth.render.mesh import MISS
from chronoscene.synth.render.noise import dot, fbm, mix, plus, rng_for, scaled, smooth, times

Color = tuple[float, float, float]


@dataclass(frozen=True, slots=True)
class Light:
    """Light settings of one period. Radiance units are relative; 1 is a white wall in the sun."""

    name: str
    season: str
    """``summer``, ``spring``, ``autumn`` or ``winter``: palette of grass and leaves."""
    azimuth: float
    """Direction to the sun, degrees from +x towards +y."""
    elevation: float
    """Degrees above the horizon."""
    sun: Color
    """Radiance of a white surface that faces the sun."""
    zenith: Color
    horizon: Color
    cloud: float
    """Share of the sky under clouds, 0..1."""
    haze: float
    """Extinction per metre."""
    exposure: float
    white: Color
    """Factors of the camera's white balance."""
    sky_seed: int = 0
    """Determines the clouds."""

    @property
    def direction(self) -> Array:
        """Unit vector towards the sun. [3]"""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        return np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])


MOODS: tuple[Light, ...] = (
    Light(
        "summer noon", "summer", azimuth=-60.0, elevation=54.0, cloud=0.45, haze=1 / 2600,
        sun=(1.95, 1.86, 1.68), zenith=(0.13, 0.27, 0.60), horizon=(0.50, 0.61, 0.72),
        exposure=0.74, white=(1.0, 1.0, 1.0),
    ),
    Light(
        "warm evening", "summer", azimuth=-158.0, elevation=20.0, cloud=0.55, haze=1 / 1500,
        sun=(2.60, 1.50, 0.68), zenith=(0.15, 0.21, 0.40), horizon=(0.68, 0.51, 0.38),
        exposure=1.12, white=(1.05, 0.98, 0.86),
    ),
    Light(
        "cool autumn morning", "autumn", azimuth=25.0, elevation=27.0, cloud=0.65, haze=1 / 1900,
        sun=(1.35, 1.38, 1.45), zenith=(0.24, 0.34, 0.52), horizon=(0.52, 0.60, 0.68),
        exposure=0.86, white=(0.91, 0.99, 1.13),
    ),
    Light(
        "overcast spring", "spring", azimuth=95.0, elevation=48.0, cloud=0.95, haze=1 / 1400,
        sun=(0.35, 0.34, 0.33), zenith=(0.62, 0.66, 0.70), horizon=(0.58, 0.61, 0.64),
        exposure=1.10, white=(0.97, 1.0, 1.03),
    ),
    Light(
        "winter noon", "winter", azimuth=-95.0, elevation=19.0, cloud=0.35, haze=1 / 1600,
        sun=(1.95, 1.66, 1.28), zenith=(0.16, 0.26, 0.50), horizon=(0.50, 0.55, 0.62),
        exposure=1.10, white=(0.98, 1.0, 1.05),
    ),
    Light(
        "spring morning", "spring", azimuth=40.0, elevation=37.0, cloud=0.50, haze=1 / 1700,
        sun=(1.95, 1.70, 1.35), zenith=(0.15, 0.28, 0.58), horizon=(0.52, 0.58, 0.64),
        exposure=0.76, white=(1.02, 1.0, 0.97),
    ),
)  # fmt: skip
"""Lights in the order in which periods use them; neighbours differ in every respect."""


def make_lights(seed: int, periods: int, *, same: bool = False) -> list[Light]:
    """One light per period: `MOODS` in order, each with the sun turned and varied slightly, or
    the first of these for all."""
    rng = rng_for(seed, "light")
    turn = float(rng.uniform(0, 360))
    lights = []
    for p in range(periods):
        mood = MOODS[p % len(MOODS)]
        azimuth = (mood.azimuth + turn + float(rng.uniform(-15, 15))) % 360
        # Later cycles through the moods must not repeat earlier ones.
        azimuth = (azimuth + 67.0 * (p // len(MOODS))) % 360
        light = replace(
            mood,
            azimuth=round(azimuth, 2),
            elevation=round(mood.elevation + float(rng.uniform(-3, 3)), 2),
            exposure=round(mood.exposure * float(rng.uniform(0.94, 1.06)), 3),
            sky_seed=100 * (p + 1) + seed % 89,
        )
        lights.append(light)
    return [lights[0]] * periods if same else lights


SkyArgs = namedtuple("SkyArgs", "direction sun zenith horizon cloud haze exposure white sky_seed")
"""The values of a light that compiled code uses."""


def sky_args(light: Light) -> SkyArgs:
    """A light for compiled code, with its colours as arrays."""
    values: dict[str, Any] = {name: getattr(light, name) for name in SkyArgs._fields}
    colors = {name: np.array(v) for name, v in values.items() if isinstance(v, tuple)}
    return SkyArgs(**(values | colors))


@inner
def sky_radiance(d, a, detail):  # type: ignore[no-untyped-def]
    """Radiance of the sky in a unit direction; without ``detail``, clouds are an even veil."""
    up = max(d[2], 0.0)
    color = mix(a.horizon, a.zenith, 1.0 - math.exp(-4.5 * up))
    towards = max(0.0, dot(d, a.direction))
    sharp = towards * towards * towards
    sharp *= sharp
    wide, sharp = 0.10 * sharp, 0.30 * sharp**8
    color = plus(color, scaled(a.sun, wide + sharp))
    # Under an overcast sky little of the blue is left.
    cover, white = 0.6 * a.cloud * a.cloud, 0.62
    if detail and up > 0.01:
        px, py = d[0] / (up + 0.12), d[1] / (up + 0.12)
        n = fbm(px, py, 1.1, 6, a.sky_seed, 0.004) + 0.3 * fbm(px, py, 3.3, 2, a.sky_seed + 7, 0.01)
        edge = 0.42 - 0.95 * a.cloud
        cover = smooth(edge, edge + 0.45, n) * smooth(0.01, 0.10, up) * 0.9
        white = 0.80 - 0.45 * smooth(edge + 0.2, edge + 0.8, n)
    cloud = scaled(plus(scaled(a.sun, 0.36), scaled(a.horizon, 0.75)), white)
    return mix(color, cloud, cover)


class Probes(NamedTuple):
    """Indirect light on a grid: radiance in spherical harmonics up to order 1."""

    origin: Array
    step: Array
    """[3]"""
    values: NDArray[np.float32]
    """Mean radiance and three slopes per colour. [X, Y, Z, 4, 3]"""
    valid: NDArray[np.float32]
    """0 inside objects, else 1. [X, Y, Z]"""


@inner
def probe_light(probes, p, d, slope):  # type: ignore[no-untyped-def]
    """Indirect radiance at a point from a direction; ``slope`` 2/3 gives irradiance / pi."""
    nx, ny, nz = probes.valid.shape
    fx = min(max((p[0] - probes.origin[0]) / probes.step[0], 0.0), nx - 1.001)
    fy = min(max((p[1] - probes.origin[1]) / probes.step[1], 0.0), ny - 1.001)
    fz = min(max((p[2] - probes.origin[2]) / probes.step[2], 0.0), nz - 1.001)
    ix, iy, iz = int(fx), int(fy), int(fz)
    color, total = (0.0, 0.0, 0.0), 0.0
    for corner in range(8):
        i, j, k = corner & 1, (corner >> 1) & 1, corner >> 2
        wx = fx - ix if i else 1.0 - fx + ix
        wy = fy - iy if j else 1.0 - fy + iy
        wz = fz - iz if k else 1.0 - fz + iz
        w = (wx * wy * wz + 1e-4) * probes.valid[ix + i, iy + j, iz + k]
        v = probes.values[ix + i, iy + j, iz + k]
        slopes = plus(plus(scaled(v[1], d[0]), scaled(v[2], d[1])), scaled(v[3], d[2]))
        c = plus(v[0], scaled(slopes, slope))
        color = plus(color, scaled((max(0.0, c[0]), max(0.0, c[1]), max(0.0, c[2])), w))
        total += w
    return scaled(color, 1.0 / max(total, 1e-9))


@kernel(parallel=True)
def probe_values(  # type: ignore[no-untyped-def]
    rays, t, tri, uv, lit, tables, mean_albedo, sky, count
):
    """Radiance up to order 1 around each probe from the rays that it cast.

    Hits receive sunlight and a constant sky. A probe is inside an object, and not valid, if more
    than a quarter of its rays hit surfaces from behind.

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
            d = (float(rays[i, 3]), float(rays[i, 4]), float(rays[i, 5]))
            if tri[i] == MISS:
                c = sky_radiance(d, sky, False)
            else:
                n = tables.normals[tri[i], 0]
                style = tables.patch_style[tables.tri_patch[tri[i]]]
                solid = tables.styles[style, 22] <= 0.0
                if solid and dot(n, d) > 0.0:
                    backs += 1
                    continue
                sun = max(0.0, dot(n, sky.direction)) if lit[i] else 0.0
                c = times(mean_albedo[style], plus(scaled(sky.sun, sun), scaled(sky.horizon, 0.4)))
            for k in range(3):
                acc[0, k] += c[k]
                for j in range(3):
                    acc[j + 1, k] += 3.0 * d[j] * c[k]
        seen = max(1, count - backs)
        if backs > 0.25 * count:
            valid[p] = 0.0
        for j in range(4):
            for k in range(3):
                values[p, j, k] = acc[j, k] / seen
    return values, valid
