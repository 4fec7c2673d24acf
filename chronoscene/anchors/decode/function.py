"""The compiled decode as a function of torch: joins the weights of the heads, calls the kernels."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numba import get_num_threads
from torch import Tensor

from chronoscene.anchors.decode.backward import decode_backward
from chronoscene.anchors.decode.forward import decode_forward, decode_opacities
from chronoscene.anchors.decode.layout import (
    CHUNK,
    AnchorGradients,
    Anchors,
    Gradients,
    Head,
    OutputGradients,
    Outputs,
    Weights,
    Work,
    gradient_sizes,
    make_layout,
    weight_sizes,
    work_sizes,
)
from chronoscene.kernels.compilation import inner, kernel
from chronoscene.kernels.memory import place, read, write

OUTPUTS = (1, 7, 3)  # Per offset, of the heads for opacity, covariance and colour


class Decode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, above: np.float32, fixed: tuple[Tensor, ...], *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        job = Job(fixed, tensors)
        outputs = job.forward(above)
        ctx.save_for_backward(*fixed, *tensors, *outputs)
        ctx.job = job
        ctx.mark_non_differentiable(outputs[1])
        return (*outputs[2:7], outputs[1])

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        # Read here although the job knows them too: torch checks that nobody changed them.
        saved = ctx.saved_tensors
        return None, None, *ctx.job.backward(saved[23:], grads[:5])


def _outputs(*tensors: Tensor) -> Outputs:
    return Outputs(*(tensor.data_ptr() for tensor in tensors))


class Job:
    """One decode, forward and back: arguments of the kernels, and the memory behind them.

    To be used while torch records no gradients.

    Args:
        fixed: Anchors, period weights, camera centre, visible anchors, used offsets, block rows.
        tensors: What gets gradients: offsets, features, blocks, log scales, global features, and
            the weights of the three heads.
    """

    def __init__(self, fixed: Sequence[Tensor], tensors: Sequence[Tensor]) -> None:
        self._shapes = [tensor.shape for tensor in tensors]
        self._period_weights = fixed[1].detach()
        anchors, weights, centre, visible, used, rows = (tensor.contiguous() for tensor in fixed)
        offsets, features, blocks, log_scales, global_features, *heads = (
            tensor.contiguous() for tensor in tensors
        )
        self.layout = make_layout(
            base=features.shape[1],
            period=blocks.shape[1],
            shared=global_features.shape[1],
            hidden=heads[0].shape[0],
            offsets=offsets.shape[1],
        )
        periods = weights.nonzero()[:, 0]
        weights = weights[periods]
        mixed = len(periods) if blocks.shape[1] else 0
        self.shared = (weights[:, None] * global_features[periods]).sum(0)
        self.heads = _heads(heads)
        self.source = Anchors(
            anchors=anchors.data_ptr(),
            offsets=offsets.data_ptr(),
            features=features.data_ptr(),
            blocks=blocks.data_ptr(),
            log_scales=log_scales.data_ptr(),
            num_anchors=len(anchors),
            centre=centre.data_ptr(),
            visible=visible.data_ptr(),
            num_visible=len(visible),
            used_offsets=used.data_ptr(),
            block_rows=rows.data_ptr(),
            periods=periods.data_ptr(),
            weights=weights.data_ptr(),
            num_periods=mixed,
            all_periods=rows.shape[1],
        )
        sizes = weight_sizes(self.layout)
        packed = torch.zeros(sum(sizes))
        self.weights = Weights(*place(sizes, packed.data_ptr()))
        pack_weights(self.layout, self.heads, self.shared.data_ptr(), self.weights)
        sizes, tasks = work_sizes(self.layout), get_num_threads()
        memory = torch.zeros(tasks * sum(sizes))
        self.work = (Work(*place(sizes, memory.data_ptr())), sum(sizes), tasks)
        # The kernels know addresses only, so this object keeps alive what is there.
        plain = (anchors, weights, centre, visible, used, rows, periods)
        self._alive = (*plain, offsets, features, blocks, log_scales, *heads, packed, memory)

    def forward(self, above: np.float32) -> tuple[Tensor, ...]:
        """Decode the Gaussians with an opacity above a number.

        Returns:
            starts: First Gaussian of each visible anchor, and L at the end. int64 [M + 1]
            positions: Of each Gaussian among all M k. int64 [L]
            splats: Means, quaternions, scales, opacities, colours. [L, .]
            inverse_norms: See `Outputs`. [L]
        """
        count = self.source.num_visible
        starts = torch.empty(count + 1, dtype=torch.int64)
        alphas = torch.empty(count * self.layout.offsets)
        places = Outputs(alphas.data_ptr(), starts.data_ptr(), *([0] * 7))
        arguments = (self.layout, self.weights, self.source, above)
        decode_opacities(*arguments, places, *self.work)
        active = int(starts[-1])
        index = torch.empty(active, dtype=torch.int64)
        shapes = ((active, 3), (active, 4), (active, 3), (active,), (active, 3), (active,))
        outputs = (starts, index, *(torch.empty(shape) for shape in shapes))
        decode_forward(*arguments, _outputs(alphas, *outputs), *self.work)
        return outputs

    def backward(self, outputs: Sequence[Tensor], grads: Sequence[Tensor]) -> list[Tensor]:
        """Return the gradients of the tensors.

        Args:
            outputs: What `forward` returned.
            grads: Of means, quaternions, scales, opacities and colours.
        """
        grads = [grad.contiguous() for grad in grads]
        out = [torch.empty(shape) for shape in self._shapes]
        out[2].zero_()
        sizes = gradient_sizes(self.layout)
        chunks = max(1, -(-self.source.num_visible // CHUNK))
        partials = torch.empty(chunks, sum(sizes))
        partial = Gradients(*place(sizes, partials.data_ptr()))
        arguments = (self.layout, self.weights, self.source, _outputs(torch.empty(0), *outputs))
        output_gradients = OutputGradients(*(grad.data_ptr() for grad in grads))
        anchor_gradients = AnchorGradients(*(tensor.data_ptr() for tensor in out[:4]))
        gradients = (output_gradients, anchor_gradients, partial, sum(sizes))
        decode_backward(*arguments, *gradients, *self.work)
        shared = torch.zeros_like(self.shared)
        ends = (self.shared.data_ptr(), _heads(out[5:]), shared.data_ptr())
        unpack_gradients(self.layout, partial, self.heads, *ends)
        out[4] = self._period_weights[:, None] * shared
        return out


def _heads(tensors: Sequence[Tensor]) -> tuple[Head, Head, Head]:
    one, two, three = (
        Head(*(tensor.data_ptr() for tensor in tensors[first : first + 4])) for first in (0, 4, 8)
    )
    return one, two, three


@inner
def _output_column(layout, head, output):  # type: ignore[no-untyped-def]
    """Return the column among the joined outputs of an output of head 0, 1, 2."""
    if head == 0:
        return output
    if head == 2:
        return layout.colors_at + output
    offset, part = output // 7, output % 7
    if part < 3:
        return layout.scales_at + 3 * offset + part
    return layout.quats_at + 4 * offset + part - 3


@kernel
def pack_weights(layout, heads, shared, out):  # type: ignore[no-untyped-def]
    """Join three `Head` into ``out``, `Weights` that are zeros at first.

    ``shared`` is the address of the mixed global feature. [G]
    """
    width = layout.inputs + layout.shared
    for head in range(3):
        source = heads[head]
        for h in range(layout.hidden):
            at = head * layout.hidden_pad + h
            bias = read(source.b1, h)
            for g in range(layout.shared):
                bias += read(source.w1, h * width + layout.inputs + g) * read(shared, g)
            write(out.b1, at, bias)
            for i in range(layout.inputs):
                value = read(source.w1, h * width + i)
                write(out.w1_t, i * layout.hiddens + at, value)
                if i < layout.features:
                    write(out.w1, at * layout.features_pad + i, value)
        for o in range(layout.offsets * OUTPUTS[head]):
            column = _output_column(layout, head, o)
            write(out.b2, column, read(source.b2, o))
            for h in range(layout.hidden):
                value = read(source.w2, o * layout.hidden + h)
                write(out.w2, column * layout.hidden_pad + h, value)
                write(out.w2_t, h * layout.outputs_pad + column, value)


@kernel
def unpack_gradients(layout, grads, heads, shared, out, shared_out):  # type: ignore[no-untyped-def]
    """Spread the `Gradients` of the joined weights over the heads and what they share.

    Args:
        heads: As in `pack_weights`, like ``shared``.
        out: Three `Head`, written.
        shared_out: Address of zeros, to which the gradient of ``shared`` is added. [G]
    """
    width = layout.inputs + layout.shared
    for head in range(3):
        source, target = heads[head], out[head]
        for h in range(layout.hidden):
            at = head * layout.hidden_pad + h
            bias = read(grads.b1, at)
            write(target.b1, h, bias)
            for i in range(layout.inputs):
                grad = read(grads.w1_t, i * layout.hiddens + at)
                write(target.w1, h * width + i, grad)
            # The bias stood for b1 + w1[:, inputs:] @ shared.
            for g in range(layout.shared):
                column = h * width + layout.inputs + g
                write(target.w1, column, bias * read(shared, g))
                total = read(shared_out, g) + bias * read(source.w1, column)
                write(shared_out, g, total)
        for o in range(layout.offsets * OUTPUTS[head]):
            column = _output_column(layout, head, o)
            write(target.b2, o, read(grads.b2, column))
            for h in range(layout.hidden):
                grad = read(grads.w2, column * layout.hidden_pad + h)
                write(target.w2, o * layout.hidden + h, grad)
