"""Materials: linear colours and the styles that are drawn from them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np

from chronoscene.synth.render import textures as tex
from chronoscene.synth.render.mesh import Color, MeshBuilder, srgb

T = TypeVar("T")

PLASTERS = (
    srgb(214, 186, 132), srgb(226, 212, 178), srgb(196, 205, 178), srgb(222, 176, 158),
    srgb(228, 224, 214), srgb(202, 130, 92), srgb(170, 190, 204), srgb(188, 180, 170),
    srgb(216, 160, 88), srgb(150, 168, 150),
)  # fmt: skip
BRICKS = (
    (srgb(150, 70, 50), srgb(112, 50, 40)),
    (srgb(132, 92, 70), srgb(96, 66, 54)),
    (srgb(198, 164, 112), srgb(168, 130, 84)),
    (srgb(122, 58, 52), srgb(160, 88, 62)),
)
PANELS = (
    (srgb(212, 214, 210), srgb(60, 110, 160)),
    (srgb(92, 112, 132), srgb(150, 170, 184)),
    (srgb(190, 120, 62), srgb(120, 72, 44)),
    (srgb(70, 78, 84), srgb(196, 190, 176)),
    (srgb(120, 150, 140), srgb(226, 222, 206)),
    (srgb(178, 58, 48), srgb(222, 216, 206)),
)
ROOFS = (
    (srgb(176, 82, 52), srgb(132, 58, 42)),
    (srgb(150, 72, 54), srgb(196, 108, 68)),
    (srgb(92, 84, 80), srgb(66, 62, 64)),
    (srgb(122, 88, 66), srgb(90, 64, 52)),
    (srgb(86, 92, 102), srgb(60, 66, 76)),
)
CARS = (
    srgb(188, 30, 28), srgb(30, 60, 130), srgb(220, 220, 222), srgb(28, 28, 32),
    srgb(120, 124, 130), srgb(206, 170, 40), srgb(24, 92, 70), srgb(160, 168, 176),
    srgb(196, 96, 30), srgb(90, 40, 60),
)  # fmt: skip
CLOTHS = (
    srgb(190, 40, 40), srgb(40, 90, 160), srgb(224, 186, 60), srgb(60, 130, 80),
    srgb(226, 222, 210), srgb(210, 110, 40),
)  # fmt: skip

GRASSES = {
    "summer": (srgb(92, 116, 48), srgb(126, 134, 62), 0.0),
    "spring": (srgb(84, 132, 50), srgb(108, 150, 60), 0.02),
    "autumn": (srgb(122, 118, 58), srgb(140, 122, 66), 0.30),
    "winter": (srgb(120, 116, 84), srgb(134, 124, 92), 0.06),
}
"""Two grass colours and the share of litter (fallen leaves or flowers)."""
CROWNS = {
    "summer": ((srgb(58, 92, 34), srgb(96, 124, 50), srgb(132, 150, 70)),
               (srgb(44, 84, 42), srgb(76, 112, 58), srgb(104, 136, 76))),
    "spring": ((srgb(96, 142, 50), srgb(132, 168, 72), srgb(206, 190, 190)),
               (srgb(84, 128, 52), srgb(118, 152, 64), srgb(150, 176, 90))),
    "autumn": ((srgb(180, 98, 26), srgb(206, 142, 40), srgb(150, 52, 24)),
               (srgb(160, 60, 28), srgb(190, 104, 32), srgb(120, 104, 36))),
    "winter": ((srgb(108, 90, 66), srgb(128, 106, 78), srgb(92, 76, 56)),
               (srgb(84, 84, 56), srgb(104, 98, 66), srgb(72, 70, 50))),
}  # fmt: skip
"""Two species per season: dark, light and accent colours of the leaves."""
EVERGREEN = (srgb(34, 66, 42), srgb(52, 84, 50), srgb(70, 96, 56))

SOILS = (srgb(150, 124, 92), srgb(118, 96, 72), srgb(176, 164, 148))
WHITE = srgb(232, 230, 224)


def pick(rng: np.random.Generator, options: Sequence[T]) -> T:
    """One of the options."""
    return options[int(rng.integers(len(options)))]


def tint(rng: np.random.Generator, color: Color, amount: float = 0.08) -> Color:
    """A random variation of a colour in brightness and hue."""
    f = np.exp(rng.normal(0, amount)) * np.exp(rng.normal(0, amount / 3, 3))
    red, green, blue = np.minimum(color * f, 0.85).tolist()
    return red, green, blue


def wall_style(b: MeshBuilder, kind: str, rng: np.random.Generator, storey: float) -> int:
    """Style of an outer wall: ``plaster``, ``brick``, ``panel`` or ``concrete``."""
    if kind == "brick":
        first, second = pick(rng, BRICKS)
        mortar = srgb(176, 168, 156)
        numbers = (0.25, 0.08, storey)
        return b.style(tex.BRICK, tint(rng, first), tint(rng, second), mortar, numbers)
    if kind == "panel":
        first, second = pick(rng, PANELS)
        size = (float(rng.uniform(1.1, 1.9)), storey / 2, float(rng.uniform(0.1, 0.35)))
        return b.style(
            tex.PANEL, tint(rng, first), tint(rng, second), srgb(50, 52, 54), size, reflect=0.03
        )
    if kind == "concrete":
        c = tint(rng, srgb(158, 152, 142))
        return b.style(tex.CONCRETE, c, srgb(112, 106, 98), None, (2.4, storey / 2))
    c = tint(rng, pick(rng, PLASTERS))
    below = srgb(120, 106, 88)
    wear = float(rng.uniform(0.0, 0.35))
    line = storey if rng.random() < 0.5 else 0.0
    return b.style(tex.PLASTER, c, srgb(168, 152, 130), below, (wear, line, 0.2))


def glass_style(b: MeshBuilder, frame: Color, panes: tuple[int, int] = (2, 2)) -> int:
    """Style of a window; the seed of each window determines its curtains."""
    room, curtain = srgb(42, 50, 60), srgb(206, 196, 176)
    return b.style(tex.GLASS, frame, room, curtain, (0.07, *panes), reflect=0.12, sharp=0.9)


def roof_tile_style(b: MeshBuilder, rng: np.random.Generator) -> int:
    """Style of a pitched roof."""
    first, second = pick(rng, ROOFS)
    moss = float(rng.uniform(0.05, 0.35))
    return b.style(
        tex.TILES, tint(rng, first), tint(rng, second), srgb(96, 100, 62), (0.3, 0.36, moss)
    )


def flat_roof_style(b: MeshBuilder, rng: np.random.Generator) -> int:
    """Style of a flat roof."""
    gravel = float(rng.random() < 0.5)
    c = tint(rng, srgb(150, 144, 134) if gravel else srgb(104, 104, 108))
    return b.style(tex.FLAT_ROOF, c, srgb(66, 66, 68), srgb(112, 106, 96), (1.1, gravel))


def asphalt_style(b: MeshBuilder, marking: int, *, parking: float = 0.0) -> int:
    """Style of a road; marking 0 none, 1 lanes, 2 zebra, 3 parking lot."""
    return b.style(
        tex.ASPHALT, srgb(84, 84, 88), srgb(112, 110, 108), srgb(224, 222, 212), (marking, parking)
    )


def grass_style(b: MeshBuilder, season: str, *, wear: float, stripes: float = 0.0) -> int:
    """Style of a lawn in a season."""
    first, second, litter = GRASSES[season]
    return b.style(tex.GRASS, first, second, srgb(132, 110, 80), (wear, litter, stripes))


def leaf_style(b: MeshBuilder, season: str, species: int, size: float) -> int:
    """Style of foliage in a season; species 2 is evergreen."""
    c0, c1, c2 = EVERGREEN if species == 2 else CROWNS[season][species]
    return b.style(tex.LEAVES, c0, c1, c2, (size, 0.10), translucent=0.35)


def soil_style(b: MeshBuilder, *, stones: float, ruts: float) -> int:
    """Style of bare ground."""
    return b.style(tex.SOIL, *SOILS, (stones, ruts))


def metal_style(b: MeshBuilder, color: Color, dust: float = 0.15) -> int:
    """Style of painted metal."""
    return b.style(tex.PAINT, color, WHITE, srgb(130, 118, 100), (dust,), reflect=0.04, sharp=0.6)


def plain_style(b: MeshBuilder, color: Color, *, strength: float = 0.25, size: float = 0.6) -> int:
    """Style of surfaces without a pattern."""
    dark = (0.8 * color[0], 0.8 * color[1], 0.8 * color[2])
    return b.style(tex.PLAIN, color, dark, None, (strength, size))


def wood_style(b: MeshBuilder, color: Color, board: float = 0.16) -> int:
    """Style of boards."""
    dark = (0.6 * color[0], 0.6 * color[1], 0.6 * color[2])
    return b.style(tex.WOOD, color, dark, None, (board, 0.02))


def sheet_style(b: MeshBuilder, color: Color, *, rust: float, band: bool) -> int:
    """Style of corrugated metal."""
    return b.style(tex.CORRUGATED, color, srgb(110, 62, 36), WHITE, (0.3, rust, float(band)))
