"""Rounding tensors with a row per anchor or Gaussian, column by column."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

TURNED = 8
"""Number of columns from which on tensors are rotated to their principal axes."""


@dataclass(frozen=True, slots=True, eq=False)
class Columns:
    """Quantisation of a tensor [N, C]: x = centre + basis y, with y in multiples of a step."""

    centre: NDArray[np.float32]
    """[C]"""
    steps: NDArray[np.float32]
    """[C]"""
    basis: NDArray[np.float16] | None
    """Principal axes of tensors with many columns, so that correlated columns share one. [C, C]"""

    @classmethod
    def of(cls, values: NDArray[np.floating]) -> Columns:
        """Columns whose steps are half of their standard deviations."""
        centre = values.mean(axis=0, dtype=np.float64)
        basis = None
        if values.shape[1] >= TURNED:
            covariance = np.cov(values.T.astype(np.float64))
            basis = np.linalg.eigh(covariance).eigenvectors.astype(np.float16)
        start = cls(centre.astype(np.float32), np.ones(values.shape[1], np.float32), basis)
        return replace(start, steps=(0.5 * start.turn(values).std(axis=0)).astype(np.float32))

    def turn(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Coordinates y of the rows of a tensor, before rounding. [N, C]"""
        centred: NDArray[np.float64] = np.subtract(values, self.centre, dtype=np.float64)
        if self.basis is None:
            return centred
        return np.asarray(np.linalg.solve(self.basis.astype(np.float64), centred.T).T, np.float64)

    def codes(self, values: NDArray[np.floating]) -> NDArray[np.int64]:
        """Multiples of the steps; a step of 0 stands for one that is larger than all values."""
        turned = self.turn(values)
        steps = np.where(self.steps > 0, self.steps, np.inf)
        return np.rint(turned / steps).astype(np.int64)

    def restore(self, codes: NDArray[np.int64]) -> NDArray[np.float32]:
        """Inverse of `codes`, to half a step before the turn."""
        return self.turn_back(codes.astype(np.float64) * self.steps)

    def turn_back(self, turned: NDArray[np.float64]) -> NDArray[np.float32]:
        """Inverse of `turn`."""
        if self.basis is not None:
            turned = turned @ self.basis.astype(np.float64).T
        return (turned + self.centre).astype(np.float32)
