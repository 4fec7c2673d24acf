"""How far a scene reaches, strays aside."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

CORE = (10.0, 90.0)
"""Percentiles between which the middle of a scene lies, even with many strays on every side."""
REACH = 0.8
"""Of the longest edge of the core, on every side: farther points are strays. One reach for all
axes, as the towers of a flat place are no strays."""
ENDS = (2.0, 98.0)
"""Percentiles of what is left that are the ends of the scene, and `BEYOND` that."""
BEYOND = 0.08
"""Of the distance between the two ends: an even spread of points is inside as a whole."""
ENOUGH = 50_000
"""Points that tell: of more, an even choice is looked at."""


def robust_range(xyz: Array) -> Array:
    """Ends of a cloud along each axis without strays: up to a tenth of all points on every side.

    Args:
        xyz: Finite places, at least one. [n, 3]

    Returns:
        The lowest and the highest coordinates; points beyond are strays. [2, 3]
    """
    xyz = xyz[:: -(-len(xyz) // ENOUGH)]
    low, high = np.percentile(xyz, CORE, axis=0)
    reach = REACH * (high - low).max()
    near = xyz[((xyz >= low - reach) & (xyz <= high + reach)).all(axis=1)]
    if 2 * len(near) < len(xyz):  # few points, or clusters: there is no middle
        near = xyz
    low, high = np.percentile(near, ENDS, axis=0)
    beyond = BEYOND * (high - low)
    return np.stack(
        [np.maximum(low - beyond, near.min(axis=0)), np.minimum(high + beyond, near.max(axis=0))]
    )
