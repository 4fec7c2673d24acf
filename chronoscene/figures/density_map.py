"""Points as an image of their density, coloured by period: readable with any number of points.

A scatter plot of half a million points shows only what was drawn last. Here the points of each
period are counted per pixel; a pixel's opacity grows with the logarithm of all its points, and its
colour is that of one of its periods, chosen at random by their shares. Where periods overlap their
colours lie side by side as fine grain, none on top of the other and none mixed to mud.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from chronoscene.arrays import Array
from chronoscene.figures.canvas import rgb_of

Counts = NDArray[np.float32]

MIN_OPACITY = 0.6  # Opacity of a pixel with one point, where others have many
DARK_QUANTILE = 0.97  # Of the pixels with points: the opacity of this many points is 1
DOT_SHARE = 0.35  # Dots grow until about this share of the occupied area is covered
MAX_DOT_RADIUS = 6  # Radius in pixels


@dataclass(frozen=True, slots=True)
class Window:
    """A rectangle of the plane and the pixels that show it."""

    low: tuple[float, float]
    high: tuple[float, float]
    width: int
    height: int


def count_points(xy: Array, group: NDArray[np.int64], groups: int, window: Window) -> Counts:
    """Count points per pixel, the first row at the top.

    Args:
        xy: Positions; those outside of the window are not counted. [n, 2]
        group: Of each point; negative ones are not counted. [n]
        groups: Number of groups, G.
        window: What is shown.

    Returns:
        Counts. [G, H, W]
    """
    low, high = np.array(window.low), np.array(window.high)
    size = np.array([window.width, window.height])
    with np.errstate(invalid="ignore"):
        at = (xy - low) / (high - low) * size
        inside = ((at >= 0) & (at < size)).all(axis=1) & (group >= 0)
    column, row = at[inside].astype(np.int64).T
    flat = (group[inside] * window.height + window.height - 1 - row) * window.width + column
    shape = (groups, window.height, window.width)
    return np.bincount(flat, minlength=int(np.prod(shape))).reshape(shape).astype(np.float32)


def dot_radius(points: int, occupied: int) -> int:
    """Choose the radius of the dots in pixels: few points stay visible, many do not merge.

    Args:
        points: Number of points.
        occupied: Pixels of the area that they lie in.
    """
    radius = 0
    while radius < MAX_DOT_RADIUS and points * _disc(radius + 1).sum() < DOT_SHARE * occupied:
        radius += 1
    return radius


def grow_dots(counts: Counts, radius: int) -> Counts:
    """Give every point a disc of this radius instead of a pixel. [G, H, W]"""
    if radius == 0:
        return counts
    disc = _disc(radius)
    padded = np.pad(counts, ((0, 0), (radius, radius), (radius, radius)))
    height, width = counts.shape[1:]
    grown = np.zeros_like(counts)
    for dy, dx in np.argwhere(disc):
        grown += padded[:, dy : dy + height, dx : dx + width]
    return grown


def _disc(radius: int) -> NDArray[np.bool_]:
    axis = np.arange(-radius, radius + 1)
    return np.asarray(axis[:, None] ** 2 + axis**2 <= (radius + 0.4) ** 2)


def shade(counts: Counts, colors: Sequence[str], *, seed: int = 0) -> NDArray[np.uint8]:
    """Turn counts into colours; equal counts and seeds give equal bytes.

    Args:
        counts: Points of each group per pixel. [G, H, W]
        colors: ``#rrggbb`` of each group.
        seed: Of the random choice of a period.

    Returns:
        RGBA, transparent where there are no points. [H, W, 4]
    """
    total = counts.sum(axis=0)
    image = np.zeros((*total.shape, 4), np.uint8)
    rows, columns = np.nonzero(total)
    if not len(rows):
        return image
    here = total[rows, columns]
    lot = np.random.default_rng(seed).random(len(here)) * here
    shares = np.cumsum(counts[:, rows, columns], axis=0)
    chosen = np.minimum((lot >= shares).sum(axis=0), len(colors) - 1)
    image[rows, columns, :3] = np.array([rgb_of(c) for c in colors])[chosen]
    image[rows, columns, 3] = np.round(255 * opacity(here))
    return image


def opacity(counts: Counts) -> Counts:
    """Compute opacities from `MIN_OPACITY` for one point to 1 in the densest pixels. [n]"""
    dark = max(float(np.quantile(counts, DARK_QUANTILE)), 2.0)
    grown = MIN_OPACITY + (1 - MIN_OPACITY) * np.log(counts) / np.log(dark)
    return np.clip(grown, MIN_OPACITY, 1.0)
