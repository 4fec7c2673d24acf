"""Training on one view by the compiled kernels, without autograd between them.

Values and gradients have the bits of the way through autograd, which defines them, and which
`AnchorTrainer` takes wherever this one does not apply.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from chronoscene.anchors.config import AnchorConfig
from chronoscene.anchors.decode import DecodeInputs
from chronoscene.anchors.decode.function import Job
from chronoscene.anchors.model import AnchorModel
from chronoscene.methods import TrainingView
from chronoscene.rasterizer import RasterInfo
from chronoscene.rasterizer.cpu import DirectRender, expected_depth
from chronoscene.rasterizer.cpu.layout import LANES
from chronoscene.rasterizer.inputs import Inputs, check_settings
from chronoscene.training import devices
from chronoscene.training.drawing import (
    Chance,
    Splats,
    camera_tensors,
    opacity_factors,
    step_background,
)
from chronoscene.training.losses import add_mean_volume
from chronoscene.training.photometric import loss_and_gradient
from chronoscene.training.sparse_depth import DepthTarget

_SCALES, _OPACITIES = (Splats._fields.index(name) for name in ("scales", "opacities"))


class DirectPass(NamedTuple):
    """Outcome of a view; the gradients are in the leaves of the model that it was drawn with."""

    loss: Tensor
    """Scalar."""
    positions: Tensor
    """Places of the Gaussians that are switched on. int64 [L]"""
    splats: Splats
    """These Gaussians. [L]"""
    info: RasterInfo


@torch.no_grad()
def learn_directly(
    seen: AnchorModel,
    inputs: DecodeInputs,
    view: TrainingView,
    photo: Tensor,
    background: Tensor,
    config: AnchorConfig,
    chance: Chance,
    target: DepthTarget | None,
) -> DirectPass | None:
    """Draw a view, compare it with its photo, and go back to the tensors of the model.

    Args:
        seen: The model of `AnchorOptimizer.seen`.
        inputs: What its decoder reads.
        view: The camera.
        photo: uint8 0..255. [H, W, 3]
        background: The usual colour behind everything. [3]
        config: Options of drawing and loss.
        chance: Decides on what is random.
        target: Depths to compare with; None where the step has no such term.

    Returns:
        None where autograd has to do it: the kernels do not run on the device, the model gives its
        decoder something else than its tensors, or hardly anything is visible.
    """
    if not _is_plain(seen, inputs):
        return None
    tensors = _trained(inputs)
    fixed = (inputs.anchors, inputs.period_weights, inputs.camera_centre)
    job = Job((*fixed, inputs.rows(), inputs.used_offsets, inputs.block_rows), tensors)
    outputs = job.forward(np.float32(0))
    splats = Splats(*outputs[2:7])
    if len(splats.means) < LANES:
        return None
    factors, drawn = opacity_factors(splats.opacities, config, chance), splats
    if factors is not None:
        drawn = splats._replace(opacities=splats.opacities * factors)
    background = step_background(background, config, chance)
    with_depth = target is not None
    render = DirectRender(_raster_inputs(drawn, view, background, config, with_depth))
    loss, image_gradient = loss_and_gradient(render.image, photo, ssim_weight=config.ssim_weight)
    depth_gradients: tuple[Tensor, ...] = ()
    if target is not None:
        term, depth_gradients = _depth_term(render, target)
        loss = loss + term
    grads = render.backward(image_gradient, *depth_gradients)
    if factors is not None:
        grads[_OPACITIES].mul_(factors)
    if config.scale_weight:
        volume = (splats.scales, splats.opacities, config.scale_weight, grads[_SCALES])
        loss = loss + add_mean_volume(*volume)
    found = job.backward(outputs, grads)
    for tensor, gradient in zip(tensors, found, strict=True):
        if tensor.is_leaf:
            tensor.grad = gradient
    return DirectPass(loss, outputs[1], splats, render.info)


def _depth_term(render: DirectRender, target: DepthTarget) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Return the term of the loss, and its gradients in opacity and weighted depth."""
    assert render.weighted is not None
    drawn = render.alpha.requires_grad_(), render.weighted.requires_grad_()
    with torch.enable_grad():
        term = target.term(expected_depth(render.weighted, render.alpha), render.alpha)
    return term.detach(), torch.autograd.grad(term, drawn)


def _is_plain(seen: AnchorModel, inputs: DecodeInputs) -> bool:
    """Return True if the kernels run here, and on the tensors of the model as they are."""
    ours = ("decode", "decode_active")
    return (
        all(getattr(type(seen), name) is getattr(AnchorModel, name) for name in ours)
        and devices.has_kernels(inputs.anchors, inputs.features)
        and inputs.features is seen.features
        and all(a is b for a, b in zip(inputs.heads, seen.heads.values(), strict=True))
    )


def _trained(inputs: DecodeInputs) -> list[Tensor]:
    tensors = (inputs.offsets, inputs.features, inputs.blocks, inputs.log_scales)
    weights = [weight for head in inputs.heads for weight in head]
    return [*tensors, inputs.global_features, *weights]


def _raster_inputs(
    splats: Splats, view: TrainingView, background: Tensor, config: AnchorConfig, render_depth: bool
) -> Inputs:
    """Return what `draw_in_training` has rasterized."""
    inputs = Inputs(
        *splats,
        *camera_tensors(view),
        width=view.width,
        height=view.height,
        near_plane=config.near_plane,
        backgrounds=background[None],
        render_depth=render_depth,
        absgrad=config.absgrad,
        antialiased=config.antialiased,
    )
    check_settings(inputs)
    return inputs
