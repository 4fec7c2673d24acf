"""The deformation field of 4DGS: six feature planes per level, a trunk, and a head per parameter.

`deform_reference` is the definition, in plain torch, and what a GPU runs; `deform` is its compiled
form on a CPU: `function` joins it to torch, `forward` and `backward` are the kernels, on memory
that `layout` describes. `smoothness` has the terms of the loss that keep the planes smooth.

Source: Wu et al., "4D Gaussian Splatting for Real-Time Dynamic Scene Rendering", CVPR 2024, section
4, and the released code.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor
from torch.nn.functional import grid_sample, linear, relu

from baselines.deformation_4dgs.field.function import Deform
from baselines.deformation_4dgs.field.layout import HEADS, PAIRS, Corner, Field
from chronoscene.checks import check_shape
from chronoscene.training import devices

_AXES = {"x": 0, "y": 1, "z": 2, "t": 3}


def deform(
    parameters: Mapping[str, Tensor], tensors: Mapping[str, Tensor], field: Field, time: float
) -> dict[str, Tensor]:
    """Deform Gaussians by the heads of a field at a time: `deform_reference`, compiled.

    Values and gradients have equal bits for any number of threads. Other types than float32 and
    other devices than a CPU go through `deform_reference`.

    Args:
        parameters: Groups of `chronoscene.gaussians.model.SHAPES`. [N, ...]
        tensors: Those of the field, as `Field.shapes` says.
        time: Place on the time axis of the planes, 0..1.

    Returns:
        Those groups that a head changes.
    """
    if not devices.has_kernels(*parameters.values(), *tensors.values()):
        return deform_reference(parameters, tensors, field, time)
    for name, shape in field.shapes().items():
        check_shape(name, tensors[name], shape)
    changed = field.changed
    inputs = [parameters[name] for name in changed]
    outputs = Deform.apply(field, time, len(changed), *inputs, *map(tensors.get, field.shapes()))
    return dict(zip(changed, outputs, strict=True))


def deform_reference(
    parameters: Mapping[str, Tensor], tensors: Mapping[str, Tensor], field: Field, time: float
) -> dict[str, Tensor]:
    """The definition of `deform` in plain torch, in the type of its arguments.

    With u the centre in the box, 0..1, and P(a, b) bilinear between the cells of a plane,

        f = levels side by side of the product over pairs of P(u_a, u_b), u_t = time,
        h = relu(trunk f + bias),  out = output relu(hidden h + bias) + bias  for every head,

    and what a head gives is added to its parameter before the activation.
    """
    hidden = relu(_linear(tensors, "trunk", _features(parameters["means"], tensors, field, time)))
    outputs = {
        head: _linear(tensors, f"{head}.output", relu(_linear(tensors, f"{head}.hidden", hidden)))
        for head in field.heads
    }
    outputs["means"] = outputs["means"] * field.offset_unit
    if "logit_opacities" in outputs:
        outputs["logit_opacities"] = outputs["logit_opacities"][:, 0]
    if "sh" in outputs:
        coefficients = outputs.pop("sh").reshape(len(hidden), -1, 3)
        outputs["sh_dc"], outputs["sh_rest"] = coefficients[:, 0], coefficients[:, 1:]
    return {name: parameters[name] + outputs[name] for name in field.changed}


def _linear(tensors: Mapping[str, Tensor], name: str, inputs: Tensor) -> Tensor:
    return linear(inputs, tensors[f"{name}.weight"], tensors[f"{name}.bias"])


def _features(means: Tensor, tensors: Mapping[str, Tensor], field: Field, time: float) -> Tensor:
    """[N, levels * channels]"""
    # Cell centres are at -1 and 1 at the ends of an axis (align_corners).
    corners = zip(means.unbind(1), field.low, field.scale, strict=True)
    places = [(place - low) * scale * 2 - 1 for place, low, scale in corners]
    places.append(torch.full_like(places[0], time * 2 - 1))
    levels = []
    for level in range(len(field.sizes)):
        feature = torch.ones_like(means[:, :1])
        for pair in PAIRS:
            plane = tensors[f"planes.{level}.{pair}"].permute(2, 0, 1)[None]
            at = torch.stack([places[_AXES[axis]] for axis in pair], 1)[None, None]
            sampled = grid_sample(plane, at, padding_mode="border", align_corners=True)
            feature = feature * sampled[0, :, 0].T
        levels.append(feature)
    return torch.cat(levels, 1)


__all__ = ["HEADS", "PAIRS", "Corner", "Field", "deform", "deform_reference"]
