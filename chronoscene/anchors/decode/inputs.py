"""Input of the decoder: anchors, features, and the weights of the MLPs."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from chronoscene.anchors.decode.layout import MIN_DISTANCE


class HeadWeights(NamedTuple):
    """One MLP with a ReLU hidden layer. I inputs, H hidden units, O outputs.

    Input order: base feature, period feature, unit direction, global feature.
    """

    w1: Tensor
    """[H, I]"""
    b1: Tensor
    """[H]"""
    w2: Tensor
    """[O, H]"""
    b2: Tensor
    """[O]"""


class DecodeInputs(NamedTuple):
    """Input of the decoder. Sizes: A anchors of which M are visible, k offsets, T periods."""

    anchors: Tensor
    """Positions in the training frame; get no gradient. [A, 3]"""
    offsets: Tensor
    """In units of the anchor's scale. [A, k, 3]"""
    features: Tensor
    """Features that all periods share. [A, Fb]"""
    blocks: Tensor
    """Features that they do not share; an anchor has one block or more. [R, Fv]"""
    log_scales: Tensor
    """Logarithms, in units of the training frame; 0:3 for offsets, 3:6 for Gaussians. [A, 6]"""
    global_features: Tensor
    """One row per period. [T, G]"""
    period_weights: Tensor
    """One-hot, or a mixture of periods. [T]"""
    opacity_head: HeadWeights
    """k outputs."""
    covariance_head: HeadWeights
    """7 k outputs: 3 scales and 4 quaternion numbers per offset."""
    color_head: HeadWeights
    """3 k outputs: rgb per offset."""
    camera_centre: Tensor
    """In the training frame; gets no gradient. [3]"""
    visible: Tensor | None
    """Ascending indices of the anchors to decode; None for all. int64 [M]"""
    used_offsets: Tensor
    """Bit j says whether an anchor uses its offset j; what it does not has opacity -1. int64 [A]"""
    block_rows: Tensor
    """Block of an anchor at a period; no two anchors share one. int64 [A, T], or [A, 0] where
    blocks have no numbers."""

    def rows(self) -> Tensor:
        """Return the indices of the anchors to decode. int64 [M]"""
        if self.visible is not None:
            return self.visible
        return torch.arange(len(self.anchors), device=self.anchors.device)

    @property
    def heads(self) -> tuple[HeadWeights, HeadWeights, HeadWeights]:
        return self.opacity_head, self.covariance_head, self.color_head


def directions(centres: Tensor, camera_centre: Tensor) -> Tensor:
    """Return unit vectors from the camera to anchors; zero for one in the camera. [M, 3]"""
    offsets = centres - camera_centre.detach()
    lengths = offsets.norm(dim=-1, keepdim=True)
    return torch.where(lengths > MIN_DISTANCE, offsets / lengths, 0)
