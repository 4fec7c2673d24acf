"""The compiled anchor decode as a function of torch."""

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
    place,
    weight_sizes,
    work_sizes,
)
from chronoscene.anchors.decode.weights import pack, unpack_gradients


class Decode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any,
        dims: tuple[int, int],
        above: np.float32,
        fixed: tuple[Tensor, ...],
        *tensors: Tensor,
    ) -> tuple[Tensor, ...]:
        job = _Job(dims, fixed, tensors)
        count = job.source.num_visible
        starts = torch.empty(count + 1, dtype=torch.int64)
        alphas = torch.empty(count * job.layout.offsets)
        places = Outputs(alphas.data_ptr(), starts.data_ptr(), *([0] * 7))
        decode_opacities(job.layout, job.weights, job.source, above, places, *job.work)
        living = int(starts[-1])
        index = torch.empty(living, dtype=torch.int64)
        shapes = ((living, 3), (living, 4), (living, 3), (living,), (living, 3), (living,))
        outputs = (starts, index, *(torch.empty(shape) for shape in shapes))
        places = _outputs(alphas, *outputs)
        decode_forward(job.layout, job.weights, job.source, above, places, *job.work)
        ctx.save_for_backward(*fixed, *tensors, *outputs)
        ctx.job = job
        ctx.mark_non_differentiable(index)
        return (*outputs[2:7], index)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        # Read here although the job knows them too: torch checks that nobody changed them.
        saved = ctx.saved_tensors
        fixed, tensors, outputs = saved[:4], saved[4:20], saved[20:]
        job = ctx.job
        grads = tuple(grad.contiguous() for grad in grads[:5])
        out = [torch.empty(tensor.shape) for tensor in tensors]
        sizes = gradient_sizes(job.layout)
        chunks = max(1, -(-job.source.num_visible // CHUNK))
        partials = torch.empty(chunks, sum(sizes))
        partial = Gradients(*place(sizes, partials.data_ptr()))
        decode_backward(
            job.layout,
            job.weights,
            job.source,
            _outputs(torch.empty(0), *outputs),
            OutputGradients(*(grad.data_ptr() for grad in grads)),
            AnchorGradients(*(tensor.data_ptr() for tensor in out[:3])),
            partial,
            sum(sizes),
            *job.work,
        )
        shared = torch.zeros_like(job.shared)
        ends = (job.shared.data_ptr(), _heads(out[4:]), shared.data_ptr())
        unpack_gradients(job.layout, partial, job.heads, *ends)
        out[3] = fixed[1].detach()[:, None] * shared
        return None, None, None, *out


def _outputs(*tensors: Tensor) -> Outputs:
    return Outputs(*(tensor.data_ptr() for tensor in tensors))


class _Job:
    """Arguments of the kernels, and the memory behind them."""

    def __init__(
        self, dims: tuple[int, int], fixed: Sequence[Tensor], tensors: Sequence[Tensor]
    ) -> None:
        anchors, weights, centre, visible = (_plain(tensor) for tensor in fixed)
        offsets, features, log_scales, global_features, *heads = (_plain(t) for t in tensors)
        self.layout = make_layout(
            base=dims[0],
            period=dims[1],
            shared=global_features.shape[1],
            hidden=heads[0].shape[0],
            offsets=offsets.shape[1],
            row=features.shape[1],
        )
        periods = weights.nonzero()[:, 0]
        weights = weights[periods]
        self.shared = (weights[:, None] * global_features[periods]).sum(0)
        self.heads = _heads(heads)
        self.source = Anchors(
            anchors=anchors.data_ptr(),
            offsets=offsets.data_ptr(),
            features=features.data_ptr(),
            log_scales=log_scales.data_ptr(),
            num_anchors=len(anchors),
            centre=centre.data_ptr(),
            visible=visible.data_ptr(),
            num_visible=len(visible),
            periods=periods.data_ptr(),
            weights=weights.data_ptr(),
            num_periods=len(periods),
        )
        sizes = weight_sizes(self.layout)
        packed = torch.zeros(sum(sizes))
        self.weights = Weights(*place(sizes, packed.data_ptr()))
        pack(self.layout, self.heads, self.shared.data_ptr(), self.weights)
        sizes, tasks = work_sizes(self.layout), get_num_threads()
        memory = torch.zeros(tasks * sum(sizes))
        self.work = (Work(*place(sizes, memory.data_ptr())), sum(sizes), tasks)
        # The kernels know addresses only, so this object keeps alive what is there.
        self._alive = (
            *(anchors, weights, centre, visible, offsets, features, log_scales, periods),
            *(*heads, packed, memory),
        )


def _plain(tensor: Tensor) -> Tensor:
    return tensor.detach().contiguous()


def _heads(tensors: Sequence[Tensor]) -> tuple[Head, Head, Head]:
    one, two, three = (
        Head(*(tensor.data_ptr() for tensor in tensors[first : first + 4])) for first in (0, 4, 8)
    )
    return one, two, three
