"""Sparse points that models start from."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from chronoscene.errors import SceneError


def finite_rows(points: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return True for points with finite coordinates. [P, 3] -> [P]

    Raises:
        SceneError: If there is none.
    """
    finite: NDArray[np.bool_] = np.isfinite(points).all(axis=1)
    if not finite.any():
        raise SceneError(
            "sparse points",
            expected="at least one point with finite coordinates",
            found=f"{len(points)} points",
            todo="triangulate some (chronoscene triangulate): models start from sparse points",
        )
    return finite


def rms_spacing(points: NDArray[np.floating], neighbours: int = 3) -> NDArray[np.float64]:
    """Compute the RMS distance of each point to its nearest others. [P, 3] -> [P]

    With fewer others than ``neighbours``, to those that there are; 0 for a lone point.
    """
    neighbours = min(neighbours, len(points) - 1)
    if neighbours < 1:
        return np.zeros(len(points))
    tree = cKDTree(points)
    # In the order of the tree, points near each other follow each other: four times as fast.
    distances = np.empty((len(points), neighbours + 1))
    distances[tree.indices], _ = tree.query(points[tree.indices], k=neighbours + 1)
    # The first neighbour is the point itself, or a twin at distance 0, which is the same.
    return np.sqrt(np.square(distances[:, 1:]).mean(axis=1))
