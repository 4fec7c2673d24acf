"""Decode anchors into Gaussians: the small MLPs of ChronoGS and Scaffold-GS.

`decode_reference` is the definition, in plain torch; `decode` is the compiled form of it.

Source: ChronoGS (arXiv 2511.18794), section 3, and Scaffold-GS, whose anchors it extends.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from chronoscene.anchors.decode.function import Decode
from chronoscene.anchors.decode.layout import MIN_DISTANCE, MIN_QUAT_NORM
from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.training.rendering import Splats

ALL = np.float32(-np.inf)
"""Opacity above which Gaussians live, if all shall."""


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


def decode_reference(
    anchors: Tensor,
    offsets: Tensor,
    features: Tensor,
    log_scales: Tensor,
    global_features: Tensor,
    period_weights: Tensor,
    opacity_head: HeadWeights,
    covariance_head: HeadWeights,
    color_head: HeadWeights,
    camera_centre: Tensor,
    visible: Tensor,
    *,
    base_dim: int,
    period_dim: int,
) -> Splats:
    """Decode the visible anchors in plain torch; the definition that `decode` is compared with.

    With e the period weights, f = (base, sum_s e_s period_s), d the unit vector from the camera to
    the anchor and g = sum_s e_s global_s, every head sees the input (f, d, g) and

        opacity = tanh(o), color = sigmoid(c), scale = exp(log_scales[3:6]) sigmoid(s),
        quat = q / |q|, mean = anchor + offset exp(log_scales[0:3]).

    Convention:
        The covariance head gives 3 scales and 4 quaternion numbers per offset, the colour head rgb
        per offset. The direction of an anchor in the camera centre is zero.

    Args:
        anchors: Positions in world units; get no gradient. [A, 3]
        offsets: In units of the anchor's scale. [A, k, 3]
        features: Base feature, then one block per period. [A, Fb + T * Fv]
        log_scales: Logarithms in world units; 0:3 for offsets, 3:6 for Gaussians. [A, 6]
        global_features: One row per period. [T, G]
        period_weights: One-hot, or a mixture of periods. [T]
        opacity_head: k outputs.
        covariance_head: 7 k outputs.
        color_head: 3 k outputs.
        camera_centre: In world units; gets no gradient. [3]
        visible: Sorted indices of the anchors to decode. int64 [M]
        base_dim: Fb.
        period_dim: Fv.
    """
    num_offsets, num_periods = opacity_head.w2.shape[0], period_weights.shape[0]
    check_shape("features", features, (anchors.shape[0], base_dim + num_periods * period_dim))
    rows = features[visible]
    periods = rows[:, base_dim:].reshape(len(visible), num_periods, period_dim)
    centres = anchors[visible].detach()
    directions = centres - camera_centre.detach()
    lengths = directions.norm(dim=-1, keepdim=True)
    directions = torch.where(lengths > MIN_DISTANCE, directions / lengths, 0)
    inputs = torch.cat(
        (
            rows[:, :base_dim],
            torch.einsum("t,mtv->mv", period_weights, periods),
            directions,
            (period_weights @ global_features).expand(len(visible), -1),
        ),
        dim=-1,
    )
    factors = torch.exp(log_scales[visible])[:, None, :]
    covariances = _mlp(inputs, covariance_head).reshape(-1, num_offsets, 7)
    return Splats(
        means=(centres[:, None] + offsets[visible] * factors[..., :3]).reshape(-1, 3),
        quats=_unit_quats(covariances[..., 3:].reshape(-1, 4)),
        scales=(factors[..., 3:] * torch.sigmoid(covariances[..., :3])).reshape(-1, 3),
        opacities=torch.tanh(_mlp(inputs, opacity_head)).reshape(-1),
        colors=torch.sigmoid(_mlp(inputs, color_head)).reshape(-1, 3),
    )


def decode(
    anchors: Tensor,
    offsets: Tensor,
    features: Tensor,
    log_scales: Tensor,
    global_features: Tensor,
    period_weights: Tensor,
    opacity_head: HeadWeights,
    covariance_head: HeadWeights,
    color_head: HeadWeights,
    camera_centre: Tensor,
    visible: Tensor,
    *,
    base_dim: int,
    period_dim: int,
) -> Splats:
    """Decode the visible anchors: `decode_reference`, compiled for float32 on a CPU.

    Only rows of visible anchors are read. Gradients of per-anchor tensors are dense, zero in other
    rows and in the blocks of periods of weight 0. Values and gradients are equal bit by bit for any
    number of threads. Other types and devices go through `decode_reference`.

    Raises:
        ShapeError: If the sizes do not fit together.
    """
    tensors = (offsets, features, log_scales, global_features)
    heads = (opacity_head, covariance_head, color_head)
    fixed = (anchors, period_weights, camera_centre, visible)
    return _decode(fixed, tensors, heads, (base_dim, period_dim), ALL)[0]


def decode_active(
    anchors: Tensor,
    offsets: Tensor,
    features: Tensor,
    log_scales: Tensor,
    global_features: Tensor,
    period_weights: Tensor,
    opacity_head: HeadWeights,
    covariance_head: HeadWeights,
    color_head: HeadWeights,
    camera_centre: Tensor,
    visible: Tensor,
    *,
    base_dim: int,
    period_dim: int,
) -> tuple[Splats, Tensor]:
    """Decode only what can be seen: `decode` without the Gaussians of opacity 0 or less.

    A rasterizer culls those anyway. With few offsets switched on this is much faster.

    Returns:
        decoded: The L living Gaussians.
        index: Their positions in the output of `decode`, ascending. int64 [L]
    """
    tensors = (offsets, features, log_scales, global_features)
    heads = (opacity_head, covariance_head, color_head)
    fixed = (anchors, period_weights, camera_centre, visible)
    return _decode(fixed, tensors, heads, (base_dim, period_dim), np.float32(0))


def _decode(
    fixed: tuple[Tensor, Tensor, Tensor, Tensor],
    tensors: tuple[Tensor, Tensor, Tensor, Tensor],
    heads: tuple[HeadWeights, HeadWeights, HeadWeights],
    dims: tuple[int, int],
    above: np.float32,
) -> tuple[Splats, Tensor]:
    anchors, period_weights, camera_centre, visible = fixed
    _check(anchors, tensors, period_weights, heads, camera_centre, visible, *dims)
    weights = [weight for head in heads for weight in head]
    floats = (*fixed[:3], *tensors, *weights)
    if all(tensor.device.type == "cpu" and tensor.dtype == torch.float32 for tensor in floats):
        *outputs, index = Decode.apply(dims, above, fixed, *tensors, *weights)
        return Splats(*outputs), index
    decoded = decode_reference(
        anchors, *tensors, period_weights, *heads, camera_centre, visible,
        base_dim=dims[0], period_dim=dims[1],
    )  # fmt: skip
    index = (~(decoded.opacities <= float(above))).nonzero()[:, 0]
    return Splats(*(value[index] for value in decoded)), index


def _check(
    anchors: Tensor,
    tensors: Sequence[Tensor],
    period_weights: Tensor,
    heads: Sequence[HeadWeights],
    camera_centre: Tensor,
    visible: Tensor,
    base_dim: int,
    period_dim: int,
) -> None:
    """Check all sizes: the kernels do not."""
    offsets, features, log_scales, global_features = tensors
    rows, periods = anchors.shape[0], period_weights.shape[0]
    hidden, count = heads[0].w1.shape[0], heads[0].b2.shape[0]
    check_shape("anchors", anchors, (rows, 3))
    check_shape("offsets", offsets, (rows, count, 3))
    check_shape("features", features, (rows, base_dim + periods * period_dim))
    check_shape("log_scales", log_scales, (rows, 6))
    check_shape("global_features", global_features, (periods, None))
    check_shape("camera_centre", camera_centre, (3,))
    check_shape("visible", visible, (None,))
    inputs = base_dim + period_dim + 3 + global_features.shape[1]
    for name, head, width in zip(("opacity", "covariance", "color"), heads, (1, 7, 3), strict=True):
        check_shape(f"{name} head w1", head.w1, (hidden, inputs))
        check_shape(f"{name} head b1", head.b1, (hidden,))
        check_shape(f"{name} head w2", head.w2, (width * count, hidden))
        check_shape(f"{name} head b2", head.b2, (width * count,))
    rising = bool((visible[1:] > visible[:-1]).all())
    if not rising or (len(visible) and (visible[0] < 0 or visible[-1] >= rows)):
        raise ShapeError(
            "visible",
            expected=f"ascending indices of {rows} anchors",
            found="others",
            todo="pass indices of rows that exist, sorted, each once",
        )


def _mlp(inputs: Tensor, head: HeadWeights) -> Tensor:
    return torch.relu(inputs @ head.w1.T + head.b1) @ head.w2.T + head.b2


def _unit_quats(quats: Tensor) -> Tensor:
    squares = quats.square().sum(-1, keepdim=True)
    valid = squares > MIN_QUAT_NORM**2
    identity = torch.zeros_like(quats)
    identity[:, 0] = 1
    return torch.where(valid, quats * torch.where(valid, squares, 1).rsqrt(), identity)
