"""The compiled slices as a function of torch."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from baselines.realtime_4dgs.slicing.kernels import slice_backward, slice_forward
from chronoscene.gaussians.model import SHAPES

OUTPUTS = tuple(SHAPES)
"""Groups that a slice has, in the order of the kernels' arguments."""


class Slice(torch.autograd.Function):
    """Arguments and result as of `slice_at`; groups in their order."""

    @staticmethod
    def forward(
        ctx: Any, time: float, cycle: float, order: int, *groups: Tensor
    ) -> tuple[Tensor, ...]:
        plain = [group.detach().contiguous() for group in groups]
        outputs = [torch.empty_like(group) for group in plain[: len(OUTPUTS)]]
        slice_forward(float(time), float(cycle), order, _arrays(plain), _arrays(outputs))
        ctx.save_for_backward(*groups)
        ctx.settings = float(time), float(cycle), order
        return tuple(outputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        _, log_scales, quats, logits, _, _, *others = ctx.saved_tensors
        inputs = [t.detach().contiguous() for t in (log_scales, quats, logits, *others)]
        grads = tuple(grad.contiguous() for grad in grads)
        found = [torch.zeros_like(tensor) for tensor in inputs]
        slice_backward(*ctx.settings, _arrays(inputs), _arrays(grads), _arrays(found))
        d_scales, d_quats, d_logits, *d_time, d_waves_dc, d_waves_rest = found
        d_waves = (d_waves_dc, d_waves_rest) if ctx.settings[-1] else (None, None)
        g_means, _, _, _, g_dc, g_rest = grads
        d_space = (g_means, d_scales, d_quats, d_logits, g_dc, g_rest)
        return None, None, None, *d_space, *d_time, *d_waves


def _arrays(tensors: Sequence[Tensor]) -> tuple[NDArray[np.float32], ...]:
    return tuple(tensor.numpy() for tensor in tensors)
