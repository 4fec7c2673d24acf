"""The decode on a GPU: products of matrices by torch, what follows them by kernels of our own.

`decode_reference` is the definition. What the MLPs say of a Gaussian becomes its place, shape and
colour in one kernel, and only if it is switched on; another one takes the gradients back.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor
from torch.nn.functional import linear

from chronoscene.anchors.decode.inputs import DecodeInputs, directions
from chronoscene.anchors.decode.layout import MIN_QUAT_NORM

BLOCK = 256
"""Gaussians to a program."""
_MIN_SQUARE = tl.constexpr(MIN_QUAT_NORM**2)


def decode(x: DecodeInputs, above: float) -> tuple[Sequence[Tensor], Tensor]:
    """Decode the Gaussians with an opacity above a number; nan counts as above.

    Returns:
        splats: Means, quaternions, scales, opacities and colours. [L, .]
        index: Of each among all M k. int64 [L]
    """
    of_each = x.anchors.detach(), x.used_offsets, x.offsets, x.features, x.log_scales
    anchors, used, offsets, features, log_scales = (_seen(x, tensor) for tensor in of_each)
    inputs = torch.cat([features, _blocks(x), directions(anchors, x.camera_centre)], dim=1)
    opacity, covariance, color = _outputs(x, inputs)
    *splats, index = _Splats.apply(
        above, anchors, used, torch.tanh(opacity), covariance, color, offsets, log_scales
    )
    return splats, index


def _seen(x: DecodeInputs, of_each: Tensor) -> Tensor:
    """Return the rows of the visible anchors."""
    return of_each if x.visible is None else of_each.index_select(0, x.visible)


def _blocks(x: DecodeInputs) -> Tensor:
    """Return the features of the visible anchors that vary, mixed by the weights. [M, Fv]"""
    rows = _seen(x, x.block_rows)
    blocks = x.blocks.index_select(0, rows.flatten()).view(*rows.shape, x.blocks.shape[1])
    weights = x.period_weights[: rows.shape[1], None]
    return (blocks * weights).sum(1) if rows.shape[1] > 1 else blocks.flatten(1) * weights[:, 0]


def _outputs(x: DecodeInputs, inputs: Tensor) -> Sequence[Tensor]:
    """Return what each MLP says, from one product for the first layers of all three."""
    w1, own = torch.cat([head.w1 for head in x.heads]), inputs.shape[1]
    shared = x.period_weights @ x.global_features  # the same for all anchors: a part of the bias
    bias = torch.cat([head.b1 for head in x.heads]) + w1[:, own:] @ shared
    hidden = linear(inputs, w1[:, :own], bias).relu().chunk(3, dim=1)
    return [linear(h, head.w2, head.b2) for h, head in zip(hidden, x.heads, strict=True)]


class _Splats(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        above: float,
        anchors: Tensor,
        used: Tensor,
        opacities: Tensor,
        covariances: Tensor,
        colors: Tensor,
        offsets: Tensor,
        log_scales: Tensor,
    ) -> tuple[Tensor, ...]:
        k = offsets.shape[1]
        count = len(anchors) * k
        flags = torch.empty(count, dtype=torch.int32, device=anchors.device)
        grid = (triton.cdiv(count, BLOCK),)
        anchors, used, opacities, covariances, colors, offsets, log_scales = (
            t.contiguous()
            for t in (anchors, used, opacities, covariances, colors, offsets, log_scales)
        )
        if count:
            alphas = torch.empty_like(opacities)
            _switch[grid](opacities, used, alphas, flags, count, above, K=k, BLOCK=BLOCK)
        else:
            alphas = opacities
        ends = flags.cumsum(0, dtype=torch.int32)
        active = int(ends[-1]) if count else 0
        index = torch.empty(active, dtype=torch.int64, device=anchors.device)
        out = [anchors.new_empty(active, n) for n in (3, 4, 3, 1, 3)]
        out[3] = out[3].view(-1)
        if active:
            read = anchors, offsets, log_scales, alphas, covariances, colors
            _place[grid](*read, flags, ends, *out, index, count, K=k, BLOCK=BLOCK)
        ctx.save_for_backward(flags, ends, covariances, offsets, log_scales, out[2], out[4])
        ctx.mark_non_differentiable(index)
        return (*out, index)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        flags, ends, covariances, offsets, log_scales, *seen = ctx.saved_tensors
        count, k = offsets.shape[:2]
        made = [
            offsets.new_empty(count, k), torch.empty_like(covariances),
            offsets.new_empty(count, 3 * k), torch.empty_like(offsets),
            torch.empty_like(log_scales),
        ]  # fmt: skip
        if count:
            width = triton.next_power_of_2(k)
            anchors = max(BLOCK // width, 1)
            _learn[(triton.cdiv(count, anchors),)](
                flags, ends, covariances, offsets, log_scales, *seen,
                *(grad.contiguous() for grad in grads[:5]), *made,
                count, K=k, WIDTH=width, BLOCK=anchors,
            )  # fmt: skip
        return None, None, None, *made


@triton.jit
def _switch(  # type: ignore[no-untyped-def]
    opacities, used, alphas, flags, count, above, K: tl.constexpr, BLOCK: tl.constexpr
):
    """Switch off the offsets that an anchor does not use, and mark what is above a number."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    inside = at < count
    bits = tl.load(used + at // K, mask=inside, other=0)
    alpha = tl.load(opacities + at, mask=inside, other=0.0)
    alpha = tl.where(((bits >> (at % K)) & 1) != 0, alpha, -1.0)
    tl.store(alphas + at, alpha, mask=inside)
    tl.store(flags + at, tl.where(alpha <= above, 0, 1), mask=inside)


@triton.jit
def _sigmoid(x):  # type: ignore[no-untyped-def]
    return 1 / (1 + tl.exp(-x))


@triton.jit
def _place(  # type: ignore[no-untyped-def]
    anchors, offsets, log_scales, alphas, covariances, colors, flags, ends,
    means, quats, scales, opacities, rgb, index, count, K: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Write the Gaussians that are marked, one after the other."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    on = at < count
    on = on & (tl.load(flags + at, mask=on, other=0) != 0)
    to = tl.load(ends + at, mask=on, other=1).to(tl.int64) - 1
    m = at // K
    tl.store(index + to, at, mask=on)
    tl.store(opacities + to, tl.load(alphas + at, mask=on, other=0.0), mask=on)
    for c in tl.static_range(3):
        reach = tl.exp(tl.load(log_scales + 6 * m + c, mask=on, other=0.0))
        offset = tl.load(offsets + 3 * at + c, mask=on, other=0.0)
        mean = tl.load(anchors + 3 * m + c, mask=on, other=0.0) + offset * reach
        tl.store(means + 3 * to + c, mean, mask=on)
        size = tl.exp(tl.load(log_scales + 6 * m + 3 + c, mask=on, other=0.0))
        share = _sigmoid(tl.load(covariances + 7 * at + c, mask=on, other=0.0))
        tl.store(scales + 3 * to + c, size * share, mask=on)
        tl.store(rgb + 3 * to + c, _sigmoid(tl.load(colors + 3 * at + c, mask=on, other=0.0)), on)
    square = tl.zeros([BLOCK], tl.float32)
    for c in tl.static_range(4):
        q = tl.load(covariances + 7 * at + 3 + c, mask=on, other=0.0)
        square += q * q
    valid = square > _MIN_SQUARE
    inverse = tl.rsqrt(tl.where(valid, square, 1.0))
    for c in tl.static_range(4):
        q = tl.load(covariances + 7 * at + 3 + c, mask=on, other=0.0)
        unit = 1.0 if c == 0 else 0.0
        tl.store(quats + 4 * to + c, tl.where(valid, q * inverse, unit), mask=on)


@triton.jit
def _learn(  # type: ignore[no-untyped-def]
    flags, ends, covariances, offsets, log_scales, scales, rgb,
    d_means, d_quats, d_scales, d_opacities, d_rgb,
    to_opacities, to_covariances, to_colors, to_offsets, to_log_scales,
    count, K: tl.constexpr, WIDTH: tl.constexpr, BLOCK: tl.constexpr,
):  # fmt: skip
    """Take the gradients of the Gaussians of some anchors back; zeros for what is not marked."""
    m = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    j = tl.arange(0, WIDTH)
    at = m[:, None] * K + j[None, :]
    anchor, inside = m < count, (m[:, None] < count) & (j[None, :] < K)
    on = tl.load(flags + at, mask=inside, other=0) != 0
    row = tl.load(ends + at, mask=on, other=1).to(tl.int64) - 1
    tl.store(to_opacities + at, tl.load(d_opacities + row, mask=on, other=0.0), mask=inside)
    for c in tl.static_range(3):
        reach = tl.exp(tl.load(log_scales + 6 * m + c, mask=anchor, other=0.0))[:, None]
        moved = tl.load(d_means + 3 * row + c, mask=on, other=0.0) * reach
        tl.store(to_offsets + 3 * at + c, moved, mask=inside)
        moved = moved * tl.load(offsets + 3 * at + c, mask=on, other=0.0)
        tl.store(to_log_scales + 6 * m + c, tl.sum(moved, axis=1), mask=anchor)
        grown = tl.load(d_scales + 3 * row + c, mask=on, other=0.0)
        grown = grown * tl.load(scales + 3 * row + c, mask=on, other=0.0)
        tl.store(to_log_scales + 6 * m + 3 + c, tl.sum(grown, axis=1), mask=anchor)
        share = _sigmoid(tl.load(covariances + 7 * at + c, mask=on, other=0.0))
        tl.store(to_covariances + 7 * at + c, grown * (1 - share), mask=inside)
        y = tl.load(rgb + 3 * row + c, mask=on, other=0.0)
        d_color = tl.load(d_rgb + 3 * row + c, mask=on, other=0.0) * y * (1 - y)
        tl.store(to_colors + 3 * at + c, d_color, mask=inside)
    square = tl.zeros([BLOCK, WIDTH], tl.float32)
    along = tl.zeros([BLOCK, WIDTH], tl.float32)
    for c in tl.static_range(4):
        q = tl.load(covariances + 7 * at + 3 + c, mask=on, other=0.0)
        square += q * q
        along += q * tl.load(d_quats + 4 * row + c, mask=on, other=0.0)
    valid = square > _MIN_SQUARE
    inverse = tl.where(valid, tl.rsqrt(tl.where(valid, square, 1.0)), 0.0)
    for c in tl.static_range(4):
        q = tl.load(covariances + 7 * at + 3 + c, mask=on, other=0.0)
        d_quat = tl.load(d_quats + 4 * row + c, mask=on, other=0.0)
        d_q = inverse * (d_quat - q * along * inverse * inverse)
        tl.store(to_covariances + 7 * at + 3 + c, d_q, mask=inside)
