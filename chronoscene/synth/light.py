"""Light of a period: sun, sky, haze, exposure; and the compiled sky."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from chronoscene.synth.noise import fbm, smooth
from chronoscene.synth.seeds import rng_for

Array = NDArray[np.float64]
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

    @property
    def direction(self) -> Array:
        """Unit vector towards the sun. [3]"""
        a, e = math.radians(self.azimuth), math.radians(self.elevation)
        return np.array([math.cos(a) * math.cos(e), math.sin(a) * math.cos(e), math.sin(e)])


MOODS: tuple[Light, ...] = (
    Light(
        "summer noon", "summer", -60.0, 54.0, (1.95, 1.85, 1.65), (0.16, 0.30, 0.62),
        (0.50, 0.60, 0.70), 0.30, 1 / 2600, 0.80, (1.0, 1.0, 1.0),
    ),
    Light(
        "warm evening", "summer", -158.0, 21.0, (2.25, 1.20, 0.50), (0.12, 0.17, 0.34),
        (0.62, 0.42, 0.27), 0.35, 1 / 1000, 0.92, (1.05, 0.98, 0.86),
    ),
    Light(
        "cool autumn morning", "autumn", 25.0, 27.0, (1.10, 1.15, 1.25), (0.20, 0.29, 0.45),
        (0.45, 0.52, 0.60), 0.55, 1 / 1100, 0.62, (0.90, 0.99, 1.14),
    ),
    Light(
        "overcast spring", "spring", 95.0, 48.0, (0.35, 0.34, 0.33), (0.62, 0.66, 0.70),
        (0.58, 0.61, 0.64), 0.95, 1 / 900, 0.98, (0.97, 1.0, 1.03),
    ),
    Light(
        "winter noon", "winter", -95.0, 19.0, (1.75, 1.50, 1.15), (0.16, 0.26, 0.50),
        (0.50, 0.55, 0.62), 0.20, 1 / 1600, 1.05, (0.98, 1.0, 1.05),
    ),
    Light(
        "spring morning", "spring", 40.0, 37.0, (1.95, 1.70, 1.35), (0.16, 0.28, 0.56),
        (0.52, 0.58, 0.62), 0.45, 1 / 1700, 0.72, (1.02, 1.0, 0.97),
    ),
)  # fmt: skip
"""Moods in the order that periods take them: neighbours differ in every respect."""


def make_lights(seed: int, periods: int) -> list[Light]:
    """One light per period: the moods in order, each turned and varied a little."""
    rng = rng_for(seed, "light")
    turn = float(rng.uniform(0, 360))
    lights = []
    for p in range(periods):
        mood = MOODS[p % len(MOODS)]
        azimuth = (mood.azimuth + turn + float(rng.uniform(-15, 15))) % 360
        # Later rounds through the moods must not repeat the earlier ones.
        azimuth = (azimuth + 67.0 * (p // len(MOODS))) % 360
        lights.append(
            Light(
                mood.name,
                mood.season,
                round(azimuth, 2),
                round(mood.elevation + float(rng.uniform(-3, 3)), 2),
                mood.sun,
                mood.zenith,
                mood.horizon,
                mood.cloud,
                mood.haze,
                round(mood.exposure * float(rng.uniform(0.94, 1.06)), 3),
                mood.white,
            )
        )
    return lights


class SkyArgs(NamedTuple):
    """What compiled code needs of a light."""

    direction: Array
    sun: Array
    zenith: Array
    horizon: Array
    cloud: float
    haze: float
    exposure: float
    white: Array


def sky_args(light: Light) -> SkyArgs:
    """Arrays of a light for compiled code."""
    return SkyArgs(
        light.direction,
        np.array(light.sun),
        np.array(light.zenith),
        np.array(light.horizon),
        light.cloud,
        light.haze,
        light.exposure,
        np.array(light.white),
    )


@njit(cache=True)
def sky_radiance(dx, dy, dz, a, detail):  # type: ignore[no-untyped-def]
    """Radiance of the sky in a unit direction; ``detail`` False leaves the clouds out."""
    up = max(dz, 0.0)
    t = 1.0 - math.exp(-3.2 * up)
    r = a.horizon[0] + (a.zenith[0] - a.horizon[0]) * t
    g = a.horizon[1] + (a.zenith[1] - a.horizon[1]) * t
    b = a.horizon[2] + (a.zenith[2] - a.horizon[2]) * t
    towards = dx * a.direction[0] + dy * a.direction[1] + dz * a.direction[2]
    glow = 0.22 * max(towards, 0.0) ** 6 + 0.35 * max(towards, 0.0) ** 60
    r, g, b = r + glow * a.sun[0], g + glow * a.sun[1], b + glow * a.sun[2]
    cover = 0.55 * a.cloud
    if detail and up > 0.015:
        px, py = dx / (up + 0.12), dy / (up + 0.12)
        n = fbm(px, py, 0.9, 5, 77, 0.004) + 0.35 * fbm(px, py, 3.1, 2, 78, 0.01)
        edge = 0.75 - 1.1 * a.cloud
        cover = smooth(edge, edge + 0.55, n) * smooth(0.015, 0.12, up) * 0.85
        white = 0.42 + 0.22 * n
    else:
        white = 0.45
    lum = 0.30 * a.horizon[0] + 0.6 * a.horizon[1] + 0.1 * a.horizon[2]
    cr = white * (0.38 * a.sun[0] + 0.55 * a.horizon[0] + 0.5 * lum)
    cg = white * (0.38 * a.sun[1] + 0.55 * a.horizon[1] + 0.5 * lum)
    cb = white * (0.38 * a.sun[2] + 0.55 * a.horizon[2] + 0.5 * lum)
    return r + (cr - r) * cover, g + (cg - g) * cover, b + (cb - b) * cover
