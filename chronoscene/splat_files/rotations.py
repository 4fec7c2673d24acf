"""Unit quaternions [N, 4] as three components [N, 3]: the largest follows from the others."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_OTHERS = np.array([[j for j in range(4) if j != i] for i in range(4)])
"""The components of a quaternion but the i-th. [4, 3]"""


def without_largest(quats: NDArray[np.floating]) -> tuple[NDArray[Any], NDArray[np.floating]]:
    """Return which component is the largest, 0 to 3, and the others where that one is positive."""
    largest, rows = np.abs(quats).argmax(axis=1), np.arange(len(quats))
    others = quats[rows[:, None], _OTHERS[largest]]
    return largest, others * np.sign(quats[rows, largest])[:, None]


def with_largest(largest: NDArray[Any], others: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the quaternions of what `without_largest` gave."""
    quats, rows = np.empty((len(others), 4)), np.arange(len(others))
    quats[rows[:, None], _OTHERS[largest]] = others
    quats[rows, largest] = np.sqrt(np.maximum(0, 1 - (others**2).sum(axis=1)))
    return quats
