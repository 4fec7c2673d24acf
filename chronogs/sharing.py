"""Anchors whose feature need not vary with the period: found in training, stored once.

ChronoGS keeps T blocks for every anchor, though most of a place does not change. The proximal step
of a group lasso draws the blocks of an anchor to their mean and makes them equal where the data
calls for little difference; such an anchor is stored with one block. Not in the paper; the proximal
step is that of Yuan and Lin 2006 (group lasso), with the deviations of an anchor as one group.
"""

from __future__ import annotations

import numpy as np
import torch
from numba import prange
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.model import AnchorLayout, AnchorModel
from chronoscene.kernels.compilation import kernel
from chronoscene.training import devices


@torch.no_grad()
def share_periods(model: AnchorModel, threshold: float) -> None:
    """Shorten the deviation of the period blocks from their mean, in place.

    With m the mean of an anchor's blocks v_s and n the norm of all v_s - m together,
    v_s = m + (v_s - m) max(0, 1 - threshold / n).
    """
    layout, features = model.layout, model.features
    if layout.period_dim == 0:
        return
    if not devices.has_kernels(features):
        blocks = features[:, layout.base_dim :].view(len(model), layout.num_periods, -1)
        mean = blocks.mean(dim=1, keepdim=True)
        norm = (blocks - mean).square().sum(dim=(1, 2), keepdim=True).sqrt()
        keep = (1.0 - threshold / norm.clamp_min(1e-30)).clamp_min(0.0)
        blocks.copy_(mean + (blocks - mean) * keep)
        return
    array = features.detach().numpy()
    _shrink(array, layout.base_dim, layout.num_periods, layout.period_dim, threshold)


@kernel(parallel=True)
def _shrink(
    features: NDArray[np.float32], base_dim: int, periods: int, dim: int, threshold: float
) -> None:
    for a in prange(len(features)):
        mean = np.zeros(dim, np.float32)
        for s in range(periods):
            for c in range(dim):
                mean[c] += features[a, base_dim + s * dim + c]
        mean /= np.float32(periods)
        square = np.float32(0.0)
        for s in range(periods):
            for c in range(dim):
                d = features[a, base_dim + s * dim + c] - mean[c]
                square += d * d
        norm = np.sqrt(square)
        keep = np.float32(1.0 - threshold / norm if norm > threshold else 0.0)
        for s in range(periods):
            for c in range(dim):
                i = base_dim + s * dim + c
                if keep > 0.0:
                    features[a, i] = mean[c] + (features[a, i] - mean[c]) * keep
                else:
                    features[a, i] = mean[c]


def changing_anchors(features: Tensor, layout: AnchorLayout) -> Tensor:
    """Whether an anchor's blocks differ between periods. bool [A]"""
    blocks = features[:, layout.base_dim :].view(
        len(features), layout.num_periods, layout.period_dim
    )
    return (blocks != blocks[:, :1]).flatten(1).any(dim=1)


def pack_features(tensors: dict[str, Tensor], layout: AnchorLayout) -> dict[str, Tensor]:
    """Replace ``features`` by what is shared and what changes; loses nothing.

    Returns:
        tensors: With ``shared_features`` [A, Fb + Fv], the base and the block of period 0;
            ``changing_anchors``, ascending, int32 [R]; ``changing_features`` [R, (T - 1) Fv], their
            other blocks.
    """
    features = tensors["features"].detach()
    shared = layout.base_dim + layout.period_dim
    rows = changing_anchors(features, layout).nonzero()[:, 0]
    others = {name: tensor for name, tensor in tensors.items() if name != "features"}
    return others | {
        "shared_features": features[:, :shared],
        "changing_anchors": rows.to(torch.int32),
        "changing_features": features[rows, shared:],
    }


def unpack_features(tensors: dict[str, Tensor], layout: AnchorLayout) -> dict[str, Tensor]:
    """Inverse of `pack_features`."""
    names = ("shared_features", "changing_anchors", "changing_features")
    shared, rows, changing = (tensors[name] for name in names)
    features = torch.cat(
        [shared, shared[:, layout.base_dim :].repeat(1, layout.num_periods - 1)], dim=1
    )
    features[rows.long(), shared.shape[1] :] = changing
    others = {name: tensor for name, tensor in tensors.items() if name not in names}
    return others | {"features": features}
