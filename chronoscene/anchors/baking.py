"""From anchors to Gaussians that depend on the direction by spherical harmonics alone.

Decoded Gaussians have another opacity, shape and colour in each view. What one of them adds to a
view, summed over the pixels, is its weight there: transmittance times falloff times opacity. Over
the given views

- the logarithms of the scales, and the rotations as dyads q q^T, are weighted means;
- the opacity is sum(weight) / sum(weight / opacity): with the light that reached the Gaussian in
  each view, it adds as much to all of them together as before;
- the colour has the spherical harmonics that fit the colours of the views best, by weighted least
  squares, held near the constant one where views are few or all on one side.

Weights are those in views with few pixels, which cost a fraction of the time and no quality
(docs/guides/using-a-run.md, "Gaussians for other programs").
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numba import prange
from torch import Tensor

from chronoscene.anchors.contribution import weigh
from chronoscene.anchors.model import AnchorModel
from chronoscene.kernels.compilation import kernel
from chronoscene.methods import View
from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.training.drawing import Splats, camera_centre_tensor
from chronoscene.training.spherical_harmonics import MAX_DEGREE, NUM_BASES, basis
from chronoscene.training.views import coarse_view

RIDGE = 0.01
"""Penalty on the squares of all coefficients but the constant one, as a share of all weights."""
MIN_WEIGHT = 1e-3
"""Pixels of coarse views that a Gaussian must fill, over all together, to be kept."""
_SHAPES: dict[str, tuple[int, ...]] = {
    "total": (),
    "light": (),
    "means": (3,),
    "log_scales": (3,),
    "dyads": (4, 4),
    "normal": (NUM_BASES * (NUM_BASES + 1) // 2,),  # the lower triangle
    "moments": (NUM_BASES, 3),
}
"""Shapes of the sums of a Gaussian."""
_GROWTH = 1.25
_AT_A_TIME = 1 << 16  # Gaussians that are solved for together, so that copies stay small


def bake(model: AnchorModel, period_weights: Tensor, views: Sequence[View]) -> GaussianCloud:
    """Make static Gaussians of what some views show.

    Args:
        model: What is decoded.
        period_weights: Of the period, see `chronoscene.training.periods`. [T]
        views: Where the result is to be right.
    """
    sums = _Sums(len(model) * model.layout.offsets)
    for view in views:
        sums.add(view, *_seen(model, period_weights, coarse_view(view)))
    return sums.gaussians()


class _Sums:
    """Sums over views for each Gaussian that any of them shows, in the order in which they appear.

    Args:
        rows: Number of Gaussians that the model can decode.
    """

    def __init__(self, rows: int) -> None:
        self._places = torch.full((rows,), -1)
        self._count = 0
        self._sums = {name: np.empty((0, *shape), np.float32) for name, shape in _SHAPES.items()}

    def add(self, view: View, rows: Tensor, splats: Splats, weights: Tensor) -> None:
        """Add what a view shows, see `_seen`."""
        at, sums = self._places_of(rows), self._tensors()
        sums["total"][at] += weights
        sums["light"][at] += weights / splats.opacities
        sums["means"][at] = splats.means  # the same in all views
        sums["log_scales"][at] += weights[:, None] * splats.scales.log()
        sums["dyads"][at] += (
            weights[:, None, None] * splats.quats[:, :, None] * splats.quats[:, None]
        )
        directions = torch.nn.functional.normalize(splats.means - camera_centre_tensor(view))
        values, targets = basis(directions, MAX_DEGREE), splats.colors - 0.5
        arrays = (at, weights, values, targets, sums["normal"], sums["moments"])
        _add(*(array.numpy() for array in arrays))

    def gaussians(self) -> GaussianCloud:
        """Return the Gaussians that fill enough pixels, in the order of the model."""
        places = self._places[self._places >= 0]
        kept = places[self._tensors()["total"][places] > MIN_WEIGHT]
        parts = zip(*map(self._solved, kept.split(_AT_A_TIME)), strict=True)
        return GaussianCloud(*(torch.cat(part).contiguous().numpy() for part in parts))

    def _places_of(self, rows: Tensor) -> Tensor:
        """Return the places of Gaussians in the sums; those that are new get one."""
        new = rows[self._places[rows] < 0]
        self._places[new] = torch.arange(self._count, self._count + len(new))
        self._count += len(new)
        if self._count > len(self._sums["total"]):
            for values in self._sums.values():  # with zeros, and without a copy where memory allows
                values.resize(int(_GROWTH * self._count), *values.shape[1:], refcheck=False)
        return self._places[rows]

    def _tensors(self) -> dict[str, Tensor]:
        """Return the sums as tensors, which are valid until these grow."""
        return {name: torch.from_numpy(values) for name, values in self._sums.items()}

    def _solved(self, at: Tensor) -> tuple[Tensor, ...]:
        """Return means, quaternions, scales, opacities and harmonics."""
        found = {name: values[at] for name, values in self._tensors().items()}
        total, normal = found["total"], torch.empty(len(at), NUM_BASES, NUM_BASES)
        row, column = torch.tril_indices(NUM_BASES, NUM_BASES)
        normal[:, row, column] = normal[:, column, row] = found["normal"]
        diagonal = normal.diagonal(dim1=1, dim2=2)
        diagonal[:, 1:] += RIDGE * total[:, None]
        return (
            found["means"],
            torch.linalg.eigh(found["dyads"]).eigenvectors[:, :, -1],
            (found["log_scales"] / total[:, None]).exp(),
            total / found["light"],
            torch.linalg.solve(normal, found["moments"]),
        )


def _seen(model: AnchorModel, period_weights: Tensor, view: View) -> tuple[Tensor, Splats, Tensor]:
    """Return the Gaussians that a view shows: numbers, Gaussians, weights, on the CPU. [L]"""
    rows, splats, weights = weigh(model, period_weights, view)
    seen = weights > 0
    kept = Splats(*(value[seen].cpu() for value in splats))
    return rows[seen].cpu(), kept, weights[seen].cpu()


@kernel(parallel=True)
def _add(rows, weights, values, targets, normal, moments):  # type: ignore[no-untyped-def]
    """Add to the normal equations of each Gaussian; each has one row at most."""
    for n in prange(len(rows)):
        row, place = rows[n], 0
        for k in range(values.shape[1]):
            weighted = weights[n] * values[n, k]
            for other in range(k + 1):
                normal[row, place + other] += weighted * values[n, other]
            place += k + 1
            for channel in range(3):
                moments[row, k, channel] += weighted * targets[n, channel]
