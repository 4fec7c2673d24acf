"""Contributions of anchors and their offsets to images, and those that carry nothing.

A Gaussian adds its weight to a view, summed over the pixels. Not in the papers of
Scaffold-GS and ChronoGS, which prune anchors by their opacity: behind others, or too small to be
seen, an anchor may be as opaque as it likes.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from chronoscene.anchors.decode import unpack_bits
from chronoscene.anchors.model import AnchorLayout, AnchorModel
from chronoscene.methods import TrainingView, View
from chronoscene.training.drawing import Splats, weights_in
from chronoscene.training.views import downscale_view


def blending_weights(splats: Splats, view: View, layout: AnchorLayout) -> Tensor:
    """Sum the weights of Gaussians over the pixels of a view. [L]"""
    everywhere = torch.ones(view.height, view.width, 3, device=splats.means.device)
    return weights_in(
        splats, view, everywhere, near_plane=layout.near_plane, antialiased=layout.antialiased
    )[:, 0]


def weigh(model: AnchorModel, period_weights: Tensor, view: View) -> tuple[Tensor, Splats, Tensor]:
    """Decode the Gaussians of a view; return numbers, anchor * k + offset, and weights. [L]"""
    k, (centre, visible) = model.layout.offsets, model.seen_from(view)
    splats, places = model.decode_active(period_weights, centre, visible)
    numbers = visible[places // k] * k + places % k
    return numbers, splats, blending_weights(splats, view, model.layout)


def least(amounts: Tensor, share: float) -> Tensor:
    """Return True for the smallest amounts, which make up no more than a share of their sum."""
    values, order = amounts.flatten().double().sort(stable=True)
    found = torch.zeros_like(order, dtype=torch.bool)
    # Sums in order, the last one included: those by `sum` depend on the number of threads.
    sums = values.cumsum(0)
    found[order] = sums <= share * sums[-1:]
    return found.view(amounts.shape)


@torch.no_grad()
def used_offsets(
    model: AnchorModel, views: Sequence[TrainingView], feature_rows: Sequence[int], share: float
) -> Tensor:
    """Find the offsets that some period needs.

    In each period, the anchors that add least are not needed, as many as add no more than the share
    of what all add to the views of the period; nor are the offsets that add least. Views count at
    half their size.

    Args:
        model: What is decoded.
        views: All training views.
        feature_rows: Which of the features that vary each view has. [V]
        share: 0 to less than 1.

    Returns:
        bool [A, k], no offset of the anchors that no period needs.
    """
    k, rows = model.layout.offsets, torch.eye(model.layout.num_periods, device=model.device)
    anchors = torch.zeros(len(model), 1, dtype=torch.bool, device=model.device)
    offsets = torch.zeros(len(model), k, dtype=torch.bool, device=model.device)
    for period in sorted({view.period for view in views}):
        total = torch.zeros(len(model) * k, device=model.device)
        for view, row in zip(views, feature_rows, strict=True):
            if view.period == period:
                numbers, _, weights = weigh(model, rows[row], downscale_view(view, 2))
                total[numbers] += weights
        amounts = total.view(-1, k)
        anchors |= ~least(amounts.sum(1, keepdim=True), share)
        offsets |= ~least(amounts, share)
    return offsets & anchors


def pack_offsets(tensors: dict[str, Tensor]) -> dict[str, Tensor]:
    """Leave out the offsets that are not used, where ``used_offsets`` says so.

    Returns:
        tensors: ``offsets`` [N, 3] anchor by anchor, ``used_offsets`` int32 [A]. Without
            ``used_offsets``, what was given.
    """
    if "used_offsets" not in tensors:
        return tensors
    bits, offsets = tensors["used_offsets"], tensors["offsets"].detach()
    kept = offsets[unpack_bits(bits, offsets.shape[1])]
    return tensors | {"offsets": kept, "used_offsets": bits.to(torch.int32)}


def unpack_offsets(tensors: dict[str, Tensor], count: int) -> dict[str, Tensor]:
    """Inverse of `pack_offsets`, with zeros for offsets that are not used."""
    if "used_offsets" not in tensors:
        return tensors
    bits, kept = tensors["used_offsets"].long(), tensors["offsets"]
    offsets = kept.new_zeros(len(bits), count, 3)
    offsets[unpack_bits(bits, count)] = kept
    return tensors | {"offsets": offsets, "used_offsets": bits}
