"""The compiled deformation as a function of torch: joins planes and weights, calls the kernels."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from baselines.deformation_4dgs.field.backward import deform_backward
from baselines.deformation_4dgs.field.forward import deform_forward
from baselines.deformation_4dgs.field.layout import (
    BLOCK,
    PAIRS,
    Field,
    Gaussians,
    Gradients,
    Planes,
    Weights,
    Work,
    gradient_shapes,
    level_sizes,
    make_layout,
    numbers,
    rows_per_part,
    weight_shapes,
    work_sizes,
)
from chronoscene.kernels.memory import place
from chronoscene.kernels.thread_pool import launch, num_workers
from chronoscene.kernels.vectors import LANES


class Deform(torch.autograd.Function):
    """Arguments and result as of `deform`: first ``groups`` groups of parameters, then tensors of
    the field in the order of `Field.shapes`."""

    @staticmethod
    def forward(
        ctx: Any, field: Field, time: float, groups: int, *tensors: Tensor
    ) -> tuple[Tensor, ...]:
        plain = [tensor.detach().contiguous() for tensor in tensors]
        source, own = plain[:groups], dict(zip(field.shapes(), plain[groups:], strict=True))
        job = _Job(field, time, own)
        outputs = [torch.empty_like(group) for group in source]
        launch(
            deform_forward,
            -(-len(source[0]) // BLOCK),
            job.layout,
            job.planes,
            job.weights,
            _gaussians(field, source),
            len(source[0]),
            np.float32(field.offset_unit),
            _gaussians(field, outputs),
            *job.work,
        )
        ctx.save_for_backward(*tensors)
        ctx.job, ctx.groups = job, groups
        return tuple(outputs)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        job, (means, *_) = ctx.job, ctx.saved_tensors
        means, count = means.detach().contiguous(), len(means)
        grads = tuple(grad.contiguous() for grad in grads)
        # Parameters are added to what the heads give, so theirs are the gradients of the outputs;
        # the means have another share, from where they are in the planes.
        d_means = grads[0].clone()
        shapes = gradient_shapes(job.layout, sum(level_sizes(job.field)))
        sizes, rows = numbers(shapes), rows_per_part(count)
        partials = torch.empty(max(1, -(-count // rows)), sum(sizes))
        launch(
            deform_backward,
            len(partials),
            job.layout,
            job.planes,
            job.weights,
            means.data_ptr(),
            _gaussians(job.field, grads),
            count,
            rows,
            np.float32(job.field.offset_unit),
            d_means.data_ptr(),
            Gradients(*place(sizes, partials.data_ptr())),
            sum(sizes),
            *job.work,
            phases=2,
        )
        parts = zip(shapes, partials[0].split(sizes), strict=True)
        sums = {name: part.view(shapes[name]) for name, part in parts}
        found = _plane_gradients(job.field, job.time, sums["planes"]) | _split(job.field, sums)
        return None, None, None, d_means, *grads[1:], *map(found.get, job.field.shapes())


class _Job:
    """Arguments of the kernels, and the memory behind them."""

    def __init__(self, field: Field, time: float, tensors: Mapping[str, Tensor]) -> None:
        self.field, self.time, self.layout = field, time, make_layout(field)
        values = _planes_at(field, time, tensors)
        starts = np.cumsum([0, *level_sizes(field)[:-1]])
        indices = torch.tensor([field.sizes, tuple(starts)], dtype=torch.int64)
        box = torch.tensor([*field.low, *field.scale])
        self.planes = Planes(
            values.data_ptr(), indices[0].data_ptr(), indices[1].data_ptr(), box.data_ptr()
        )
        shapes = weight_shapes(self.layout)
        sizes = numbers(shapes)
        packed = torch.zeros(sum(sizes))
        self.weights = Weights(*place(sizes, packed.data_ptr()))
        parts = zip(shapes, packed.split(sizes), strict=True)
        _join(field, tensors, {name: part.view(shapes[name]) for name, part in parts})
        spaces = work_sizes(self.layout)
        memory = torch.zeros(num_workers() * sum(spaces))
        self.work = (Work(*place(spaces, memory.data_ptr())), sum(spaces))
        # The kernels know addresses only, so this object keeps alive what is there.
        self._alive = (values, indices, box, packed, memory)


def _gaussians(field: Field, tensors: Sequence[Tensor]) -> Gaussians:
    addresses = (tensor.data_ptr() for tensor in tensors)
    return Gaussians(**dict(zip(field.changed, addresses, strict=True)))


def time_cell(field: Field, time: float) -> tuple[int, float]:
    """Row of the planes with time that a time is in, and how far towards the next."""
    row = min(max(time, 0.0), 1.0) * (field.time_cells - 1)
    cell = min(int(row), field.time_cells - 2)
    return cell, row - cell


def _planes_at(field: Field, time: float, tensors: Mapping[str, Tensor]) -> Tensor:
    """`Planes.values`."""
    cell, share = time_cell(field, time)
    parts = []
    for level in range(len(field.sizes)):
        planes = {pair: tensors[f"planes.{level}.{pair}"] for pair in PAIRS}
        parts += [planes[pair] for pair in ("xy", "xz", "yz")]
        for pair in ("xt", "yt", "zt"):
            a, b = planes[pair][cell : cell + 2]
            parts.append(a + share * (b - a))
    return torch.cat([*(part.reshape(-1) for part in parts), torch.zeros(LANES)])


def _plane_gradients(field: Field, time: float, sums: Tensor) -> dict[str, Tensor]:
    """Gradients of the planes from those of `Planes.values`."""
    cell, share = time_cell(field, time)
    found, start = {}, 0
    for level, size in enumerate(field.sizes):
        for pair in ("xy", "xz", "yz", "xt", "yt", "zt"):
            rows = 1 if pair[1] == "t" else size
            stop = start + rows * size * field.channels
            grad = sums[start:stop].view(rows, size, field.channels)
            if pair[1] == "t":
                line = grad[0]
                grad = torch.zeros(field.time_cells, size, field.channels)
                grad[cell], grad[cell + 1] = line - share * line, share * line
            found[f"planes.{level}.{pair}"] = grad
            start = stop
    return found


def _blocks(field: Field) -> list[tuple[str, str, slice, slice]]:
    """Place of each layer in the joined weights: its name, that of the weight, rows, columns. A
    bias goes with its rows."""
    layout = make_layout(field)
    inside = slice(0, field.width)
    blocks = [("trunk", "trunk", inside, slice(0, layout.features))]
    row = 0
    for number, head in enumerate(field.heads):
        first = number * layout.width_pad
        units = slice(first, first + field.width)
        blocks.append((f"{head}.hidden", "hidden", units, inside))
        if head == "sh":
            blocks.append((f"{head}.output", "color", slice(None), inside))
        else:
            stop = row + field.shapes()[f"{head}.output.bias"][0]
            blocks.append((f"{head}.output", "small", slice(row, stop), units))
            row = stop
    return blocks


def _join(field: Field, tensors: Mapping[str, Tensor], out: dict[str, Tensor]) -> None:
    """Write the joined weights into zeros."""
    for layer, name, rows, columns in _blocks(field):
        weight = tensors[f"{layer}.weight"]
        out[name][rows, columns] = weight
        out[f"{name}_t"][columns, rows] = weight.T
        out[f"{name}_bias"][rows] = tensors[f"{layer}.bias"]


def _split(field: Field, sums: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Gradients of the layers from those of the joined weights."""
    found = {}
    for layer, name, rows, columns in _blocks(field):
        grad = sums[name][rows, columns] if name in sums else sums[f"{name}_t"][columns, rows].T
        found[f"{layer}.weight"] = grad.contiguous()
        found[f"{layer}.bias"] = sums[f"{name}_bias"][rows].clone()
    return found
