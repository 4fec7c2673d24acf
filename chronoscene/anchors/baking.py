"""From anchors to Gaussians that depend on the direction by spherical harmonics alone.

Decoded Gaussians have another opacity, shape and colour in each view. What one of them adds to a
view, summed over the pixels, is its weight there: transmittance times falloff times opacity. Over
the given views

- the logarithms of the scales, and the rotations as dyads q q^T, are weighted means;
- the opacity is sum(weight) / sum(weight / opacity): with the light that reached the Gaussian in
  each view, it adds as much to all of them together as before;
- the colour has the spherical harmonics that fit the colours of the views best, by weighted least
  squares, held near the constant one where views are few or all on one side.
"""

from __future__ import annotations

from collections.abc import Sequence

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

RIDGE = 0.01
"""Penalty on the squares of all coefficients but the constant one, as a share of all weights."""
MIN_WEIGHT = 1e-3
"""Pixels that a Gaussian must fill, over all views together, to be kept."""


def bake(model: AnchorModel, period_weights: Tensor, views: Sequence[View]) -> GaussianCloud:
    """Make static Gaussians of what some views show.

    Args:
        model: What is decoded.
        period_weights: Of the period, see `chronoscene.training.periods`. [T]
        views: Where the result is to be right.
    """
    totals = torch.zeros(len(model) * model.layout.offsets)
    for view in views:
        rows, _, weights = _seen(model, period_weights, view)
        totals[rows] += weights
    kept = totals > MIN_WEIGHT
    place, count = kept.cumsum(0) - 1, int(kept.sum())
    means, log_scales, light = torch.zeros(count, 3), torch.zeros(count, 3), torch.zeros(count)
    dyads, moments = torch.zeros(count, 4, 4), torch.zeros(count, NUM_BASES, 3)
    normal = torch.zeros(count, NUM_BASES, NUM_BASES)
    for view in views:  # again, as all that all views decode may not fit into memory
        rows, splats, weights = _seen(model, period_weights, view)
        used = kept[rows]
        at, w = place[rows[used]], weights[used]
        splats = Splats(*(value[used] for value in splats))
        means[at] = splats.means  # the same in all views
        log_scales[at] += w[:, None] * splats.scales.log()
        dyads[at] += w[:, None, None] * splats.quats[:, :, None] * splats.quats[:, None, :]
        light[at] += w / splats.opacities
        directions = torch.nn.functional.normalize(splats.means - camera_centre_tensor(view))
        arrays = (at, w, basis(directions, MAX_DEGREE), splats.colors - 0.5, normal, moments)
        _add(*(array.numpy() for array in arrays))
    total = totals[kept]
    diagonal = normal.diagonal(dim1=1, dim2=2)
    diagonal[:, 1:] += RIDGE * total[:, None]
    tensors = (
        means,
        torch.linalg.eigh(dyads).eigenvectors[:, :, -1],
        (log_scales / total[:, None]).exp(),
        total / light,
        torch.linalg.solve(normal, moments),
    )
    return GaussianCloud(*(tensor.contiguous().numpy() for tensor in tensors))


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
        row = rows[n]
        for k in range(values.shape[1]):
            weighted = weights[n] * values[n, k]
            for other in range(values.shape[1]):
                normal[row, k, other] += weighted * values[n, other]
            for channel in range(3):
                moments[row, k, channel] += weighted * targets[n, channel]
