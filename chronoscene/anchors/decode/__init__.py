"""Decode anchors into Gaussians: the small MLPs of Scaffold-GS and ChronoGS.

`decode_reference` is the definition, in plain torch; `decode` is its compiled form: `function`
joins it to torch, `forward` and `backward` are the kernels, on memory that `layout` describes;
`gpu` is what a GPU runs.

Source: Scaffold-GS (Lu et al., CVPR 2024), section 3.2, and ChronoGS (arXiv 2511.18794), section 3,
which adds the features that vary with the period.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from chronoscene.anchors.decode.function import Decode
from chronoscene.anchors.decode.inputs import DecodeInputs, HeadWeights, directions
from chronoscene.anchors.decode.layout import MIN_QUAT_NORM
from chronoscene.checks import check_shape
from chronoscene.errors import ShapeError
from chronoscene.training import devices
from chronoscene.training.drawing import Splats

_ALL = np.float32(-np.inf)  # Opacity above which Gaussians are active, if all are to be


def pack_bits(used: Tensor) -> Tensor:
    """Pack column j into bit j. bool [A, k] -> int64 [A]"""
    return (used.long() << torch.arange(used.shape[1], device=used.device)).sum(1)


def unpack_bits(bits: Tensor, count: int) -> Tensor:
    """Unpack what `pack_bits` packed. [A] -> bool [A, k]"""
    places = torch.arange(count, device=bits.device)
    return (bits[:, None].long() >> places & 1).bool()


def decode_reference(x: DecodeInputs) -> Splats:
    """Decode the visible anchors in plain torch: the definition of `decode`.

    With e the period weights, f = (base, sum_s e_s block_s), d the unit vector from the camera to
    the anchor and g = sum_s e_s global_s, every head sees the input (f, d, g) and

        opacity = tanh(o), color = sigmoid(c), scale = exp(log_scales[3:6]) sigmoid(s),
        quat = q / |q|, mean = anchor + offset exp(log_scales[0:3]).

    The direction of an anchor in the camera centre is zero.

    Returns:
        splats: k to each visible anchor, anchor by anchor; opacities -1..1, colours 0..1. [M * k]
    """
    num_offsets = x.opacity_head.w2.shape[0]
    visible = x.rows()
    # Not x.features[visible], whose gradient would be sorted by rows.
    rows = x.block_rows.index_select(0, visible).flatten()
    shape = (len(visible), x.block_rows.shape[1], x.blocks.shape[1])
    blocks = x.blocks.index_select(0, rows).view(shape)
    centres = x.anchors.index_select(0, visible).detach()
    inputs = torch.cat(
        (
            x.features.index_select(0, visible),
            torch.einsum("t,mtv->mv", x.period_weights[: blocks.shape[1]], blocks),
            directions(centres, x.camera_centre),
            (x.period_weights @ x.global_features).expand(len(visible), -1),
        ),
        dim=-1,
    )
    factors = torch.exp(x.log_scales.index_select(0, visible))[:, None, :]
    offsets = x.offsets.index_select(0, visible)
    covariances = mlp(inputs, x.covariance_head).reshape(-1, num_offsets, 7)
    used = unpack_bits(x.used_offsets.index_select(0, visible), num_offsets)
    opacities = torch.where(used, torch.tanh(mlp(inputs, x.opacity_head)), -1)
    return Splats(
        means=(centres[:, None] + offsets * factors[..., :3]).reshape(-1, 3),
        quats=_unit_quats(covariances[..., 3:].reshape(-1, 4)),
        scales=(factors[..., 3:] * torch.sigmoid(covariances[..., :3])).reshape(-1, 3),
        opacities=opacities.reshape(-1),
        colors=torch.sigmoid(mlp(inputs, x.color_head)).reshape(-1, 3),
    )


def decode(x: DecodeInputs) -> Splats:
    """Decode the visible anchors: `decode_reference`, compiled for float32 on a CPU.

    Only rows of visible anchors are read. Gradients of per-anchor tensors are dense, zero in other
    rows and in the blocks of periods of weight 0. Values and gradients have equal bits for any
    number of threads. A GPU has kernels of its own; other types go through `decode_reference`.

    Raises:
        ShapeError: If the sizes do not fit together.
    """
    return _decode(x, _ALL)[0]


def decode_active(x: DecodeInputs) -> tuple[Splats, Tensor]:
    """Decode only what can be seen: `decode` without the Gaussians of opacity 0 or less.

    A rasterizer culls those anyway. Where most offsets are switched off this is much faster.

    Returns:
        splats: The L active Gaussians.
        index: Their positions in the output of `decode`, ascending. int64 [L]
    """
    return _decode(x, np.float32(0))


def _decode(x: DecodeInputs, above: np.float32) -> tuple[Splats, Tensor]:
    _check(x)
    tensors = (x.offsets, x.features, x.blocks, x.log_scales, x.global_features)
    weights = [weight for head in x.heads for weight in head]
    floats = (x.anchors, x.period_weights, x.camera_centre, *tensors, *weights)
    if devices.has_kernels(*floats):
        visible = x.rows()
        _check_visible(visible, len(x.anchors))
        _check_block_rows(x.block_rows, len(x.blocks))
        fixed = (
            x.anchors, x.period_weights, x.camera_centre, visible, x.used_offsets, x.block_rows
        )  # fmt: skip
        *outputs, index = Decode.apply(above, fixed, *tensors, *weights)
        return Splats(*outputs), index
    if devices.has_gpu_kernels(*floats):
        from chronoscene.anchors.decode import gpu

        found, index = gpu.decode(x, float(above))
        return Splats(*found), index
    splats = decode_reference(x)
    index = (~(splats.opacities <= float(above))).nonzero()[:, 0]
    return Splats(*(value.index_select(0, index) for value in splats)), index


def _check(x: DecodeInputs) -> None:
    """Check all sizes: the kernels do not."""
    rows, periods = x.anchors.shape[0], x.period_weights.shape[0]
    hidden, count = x.opacity_head.w1.shape[0], x.opacity_head.b2.shape[0]
    check_shape("anchors", x.anchors, (rows, 3))
    check_shape("offsets", x.offsets, (rows, count, 3))
    check_shape("features", x.features, (rows, None))
    check_shape("blocks", x.blocks, (None, None))
    check_shape("block_rows", x.block_rows, (rows, periods if x.blocks.shape[1] else 0))
    check_shape("log_scales", x.log_scales, (rows, 6))
    check_shape("global_features", x.global_features, (periods, None))
    check_shape("camera_centre", x.camera_centre, (3,))
    if x.visible is not None:
        check_shape("visible", x.visible, (None,))
    check_shape("used_offsets", x.used_offsets, (rows,))
    inputs = x.features.shape[1] + x.blocks.shape[1] + 3 + x.global_features.shape[1]
    names = ("opacity", "covariance", "color")
    for name, head, width in zip(names, x.heads, (1, 7, 3), strict=True):
        check_shape(f"{name} head w1", head.w1, (hidden, inputs))
        check_shape(f"{name} head b1", head.b1, (hidden,))
        check_shape(f"{name} head w2", head.w2, (width * count, hidden))
        check_shape(f"{name} head b2", head.b2, (width * count,))


def _check_visible(visible: Tensor, rows: int) -> None:
    """Check the indices: the kernels read whatever they point at."""
    rising = bool((visible[1:] > visible[:-1]).all())
    if not rising or (len(visible) and (visible[0] < 0 or visible[-1] >= rows)):
        raise ShapeError(
            "visible",
            expected=f"ascending indices of {rows} anchors",
            found=f"{visible[:8].tolist()}, at most {int(visible.max())}",
            todo="pass indices of rows that exist, sorted, each once",
        )


def _check_block_rows(block_rows: Tensor, rows: int) -> None:
    """Check the indices: the kernels read whatever they point at."""
    if block_rows.numel() and not 0 <= int(block_rows.min()) <= int(block_rows.max()) < rows:
        raise ShapeError(
            "block_rows",
            expected=f"indices of {rows} blocks",
            found=f"{int(block_rows.min())} to {int(block_rows.max())}",
            todo="pass indices of rows that exist",
        )


def mlp(inputs: Tensor, head: HeadWeights) -> Tensor:
    """Compute outputs before the activation. [M, I] -> [M, O]"""
    return torch.relu(inputs @ head.w1.T + head.b1) @ head.w2.T + head.b2


def _unit_quats(quats: Tensor) -> Tensor:
    squares = quats.square().sum(-1, keepdim=True)
    valid = squares > MIN_QUAT_NORM**2
    identity = torch.zeros_like(quats)
    identity[:, 0] = 1
    return torch.where(valid, quats * torch.where(valid, squares, 1).rsqrt(), identity)
