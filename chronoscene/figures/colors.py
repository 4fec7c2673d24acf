"""One colour per period."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

FOUR = ("#b5121b", "#f5c211", "#2458c8", "#55c878")
"""Red, yellow, blue, green: the colours of the paper's figures for up to four periods. The red is
dark and the green light, so that they differ for the colour-blind, too."""

EIGHT = (
    *("#124595", "#ff9103", "#00a769", "#a468d0"),
    *("#32cfff", "#c83b11", "#694557", "#ffd151"),
)
"""Told apart on white and on dark grounds with any form of colour blindness.

Source: hues of Okabe and Ito 2008, with grey for black, moved apart until the smallest distance
between two of them, or one and a ground, was largest for all three forms in the model of Machado,
Oliveira and Fernandes 2009.
"""

_RAMP = ("#440154", "#46327e", "#365c8d", "#277f8e", "#1fa187", "#4ac16d", "#a0da39", "#e8d21d")
"""Dark to light, so the order can be seen without colours. Source: viridis, the end darkened."""


def period_colors(periods: int) -> list[str]:
    """Colours of the periods as ``#rrggbb``: four or eight that are far apart, else a ramp."""
    for palette in (FOUR, EIGHT):
        if periods <= len(palette):
            return list(palette[:periods])
    anchors = np.array([rgb_of(color) for color in _RAMP])
    at = np.linspace(0, len(anchors) - 1, periods)
    channels = [np.interp(at, np.arange(len(anchors)), anchors[:, c]) for c in range(3)]
    return ["#{:02x}{:02x}{:02x}".format(*map(round, rgb)) for rgb in zip(*channels, strict=True)]


def rgb_of(color: str) -> NDArray[np.float64]:
    """Red, green and blue, 0..255, of ``#rrggbb``. [3]"""
    return np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)], np.float64)
