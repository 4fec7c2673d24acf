"""The part of space that a field resolves well, and the contraction of all the rest.

Source of the contraction: Barron et al. 2022, "Mip-NeRF 360", equation 10, with the largest
coordinate as norm.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy import float32
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.kernels.compilation import inlined
from chronoscene.methods import TrainingSet, View
from chronoscene.scene.geometry import camera_centre

_ONE, _TWO, _QUARTER = float32(1), float32(2), float32(0.25)
_OUTLIERS = 0.5  # Per cent of the sparse points that may lie beyond each side
_MARGIN = 0.1  # Of the extent, added to each side
_FLATTEST = 0.1  # Of the longest side, the others have at least
_FEW_POINTS = 10
_FEWEST_CELLS = 16


@dataclass(frozen=True)
class SceneBox:
    """Box around the sparse points, in a cube whose coordinates run from -1 to 1."""

    centre: tuple[float, float, float]
    """Centre of the cube, in the training frame."""
    half: float
    """Half an edge of the cube, in units of the training frame."""
    sides: tuple[float, float, float]
    """Half edges of the box within the cube, at most 1."""

    def to_cube(self, points: Tensor) -> Tensor:
        """Move points of the training frame into the coordinates of the cube. [N, 3]"""
        axes = zip(points.double().unbind(1), self.centre, strict=True)
        return torch.stack([(x - middle) / self.half for x, middle in axes], dim=1).float()


def finite_points(train: TrainingSet) -> NDArray[np.float32]:
    """Return the sparse points whose coordinates are finite. [P, 3]"""
    return train.points[np.isfinite(train.points).all(axis=1)]


def box_of(train: TrainingSet) -> SceneBox:
    """Return the box of the sparse points; that of the cameras where there are hardly any."""
    points = finite_points(train).astype(np.float64)
    if len(points) < _FEW_POINTS:
        points = np.stack([camera_centre(view.cam_from_world) for view in train.views])
        points = np.concatenate((points, points.mean(axis=0) + np.array([[-1.0], [1.0]])))
    low, high = np.percentile(points, (_OUTLIERS, 100 - _OUTLIERS), axis=0)
    extent = np.maximum(high - low, _FLATTEST * (high - low).max()) * (1 + 2 * _MARGIN)
    half = float(extent.max()) / 2
    x, y, z = (low + high) / 2
    a, b, c = extent / extent.max()
    return SceneBox((float(x), float(y), float(z)), half, (float(a), float(b), float(c)))


def sensible_cells(views: Sequence[View], box: SceneBox) -> int:
    """Return how many cells along an edge of the cube are about as large as a pixel there."""
    centres = np.stack([camera_centre(view.cam_from_world) for view in views])
    distances = np.linalg.norm(centres - np.array(box.centre), axis=1)
    pixels = np.median(distances / np.array([view.K[0, 0] for view in views]))
    return max(_FEWEST_CELLS, int(2 * box.half / max(float(pixels), 1e-9)))


@inlined
def contract(x, y, z):  # type: ignore[no-untyped-def]
    """Move a place into the unit cube: the cube of the scene is the middle of it, half as long.

    With n the largest absolute coordinate, places of n > 1 go to (2 - 1/n) x / n first.
    """
    n = max(abs(x), max(abs(y), abs(z)))
    scale = (_TWO - _ONE / n) / n if n > _ONE else _ONE
    return (
        float32((x * scale + _TWO) * _QUARTER),
        float32((y * scale + _TWO) * _QUARTER),
        float32((z * scale + _TWO) * _QUARTER),
    )


def contract_reference(places: Tensor) -> Tensor:
    """Move places into the unit cube in plain torch: the definition of `contract`. [..., 3]"""
    n = places.abs().amax(-1, keepdim=True).clamp_min(1)
    return (places * ((2 - 1 / n) / n) + 2) / 4
