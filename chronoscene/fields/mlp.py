"""Small networks of which rows of a group, the samples of a ray, share a part of the input."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, Literal, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.checks import check_shape
from chronoscene.fields.mlp_kernels import Layers, mlp_backward, mlp_forward
from chronoscene.kernels.matmul import padded
from chronoscene.training import devices

Activation = Literal["none", "sigmoid"]
_CHUNK_ROWS = 1024  # At least, but for the last chunk
_ROWS_PER_WEIGHT = 1 / 16  # Large networks have fewer chunks: each has gradients of its own


class Groups(NamedTuple):
    """Groups of consecutive rows, the samples of each ray."""

    starts: Tensor
    """First row of each group, and the number of rows. int64 [R + 1]"""
    of_row: Tensor
    """Group of each row. int32 [N]"""


def make_groups(starts: Tensor, rows: int | None = None) -> Groups:
    """Make groups of the first row of each, and the number of all rows. int64 [R + 1]

    Args:
        starts: First rows, and the number of all.
        rows: The number of all, if the host knows it; otherwise it waits for it.
    """
    rows = int(starts[-1]) if rows is None else rows
    numbers = torch.arange(len(starts) - 1, dtype=torch.int32, device=starts.device)
    return Groups(starts, torch.repeat_interleave(numbers, starts.diff(), output_size=rows))


def equal_groups(rows: int, size: int, device: str | torch.device) -> Groups:
    """Make groups of so many rows each, the last one of fewer."""
    starts = torch.arange(0, rows + size, size, device=device).clamp_max(rows)
    return make_groups(starts, rows)


def mlp_reference(
    x: Tensor, shared: Tensor, groups: Groups, layers: Sequence[Tensor], output: Activation = "none"
) -> Tensor:
    """Compute the outputs in plain torch: the definition of `mlp`."""
    h = torch.cat((x, shared.index_select(0, groups.of_row)), dim=1)
    for i in range(0, len(layers), 2):
        h = h @ layers[i].T + layers[i + 1]
        if i + 2 < len(layers):
            h = torch.relu(h)
    return torch.sigmoid(h) if output == "sigmoid" else h


def mlp(
    x: Tensor, shared: Tensor, groups: Groups, layers: Sequence[Tensor], output: Activation = "none"
) -> Tensor:
    """Send rows through layers with ReLU between: `mlp_reference`, compiled for float32 on a CPU.

    Args:
        x: What each row has of its own. [N, I]
        shared: What the rows of each group share; it comes after x in the input. [R, J]
        groups: Group of each row.
        layers: Matrix [outputs, inputs] and bias [outputs] of each layer, one after the other.
        output: Function at the end.

    Returns:
        Outputs. [N, O]
    """
    check_shape("x", x, (len(groups.of_row), None))
    check_shape("shared", shared, (len(groups.starts) - 1, None))
    check_shape("first layer", layers[0], (None, x.shape[1] + shared.shape[1]))
    if devices.has_kernels(x, shared, *layers):
        return _Mlp.apply(x, shared, groups, output, *layers)
    return mlp_reference(x, shared, groups, layers, output)


def initial_layers(widths: Sequence[int], generator: torch.Generator) -> list[Tensor]:
    """Draw matrices uniformly (Glorot and Bengio 2010), with biases of zero."""
    layers = []
    for inputs, outputs in pairwise(widths):
        bound = (6 / (inputs + outputs)) ** 0.5
        layers.append((2 * torch.rand(outputs, inputs, generator=generator) - 1) * bound)
        layers.append(torch.zeros(outputs))
    return layers


def _describe(inputs: int, shared: int, layers: Sequence[Tensor], sigmoid: bool) -> Layers:
    """Place all weights in one array: matrices, biases, and last the transposes."""
    depth = len(layers) // 2
    widths = [padded(inputs), *(padded(len(m)) for m in layers[::2])]
    shared_pad = padded(shared)
    sizes = [a * b for a, b in pairwise(widths)] + [shared_pad * widths[1]]
    ends = np.cumsum([*sizes, *widths[1:], *sizes])
    places = np.concatenate(([0], ends[:-1])).astype(np.int64)
    hidden = np.concatenate(([0], np.cumsum(widths[1:-1]))).astype(np.int64)
    return Layers(
        np.array(widths, np.int64),
        places[: depth + 1],
        places[2 * depth + 1 :],
        places[depth + 1 : 2 * depth + 1],
        hidden,
        inputs,
        layers[-1].shape[0],
        shared,
        shared_pad,
        int(hidden[-1]),
        int(places[2 * depth + 1]),
        sigmoid,
    )


def _pack(about: Layers, layers: Sequence[Tensor]) -> NDArray[np.float32]:
    """Write all weights where `Layers` says."""
    weights = np.zeros(2 * about.size, np.float32)
    for at, shape, part in _matrices(about, layers):
        for place, matrix, size in (
            (about.matrix, part.T, shape),
            (about.transposed, part, shape[::-1]),
        ):
            target = weights[place[at] : place[at] + size[0] * size[1]].reshape(size)
            target[: matrix.shape[0], : matrix.shape[1]] = matrix
    for at, bias in enumerate(layers[1::2]):
        weights[about.bias[at] : about.bias[at] + len(bias)] = bias.detach().numpy()
    return weights


def _matrices(about: Layers, layers: Sequence[Tensor]) -> list[tuple[int, tuple[int, int], Any]]:
    """Number, padded size [inputs, outputs] and values [outputs, inputs] of each matrix."""
    widths = about.widths.tolist()
    found = [
        (i, (widths[i], widths[i + 1]), matrix.detach().numpy())
        for i, matrix in enumerate(layers[::2])
    ]
    first = found[0][2]
    found[0] = (0, found[0][1], first[:, : about.inputs])
    shared = (len(widths) - 1, (about.shared_pad, widths[1]), first[:, about.inputs :])
    return [*found, shared]


def _unpack(about: Layers, gradient: NDArray[np.float32], layers: Sequence[Tensor]) -> list[Tensor]:
    """Read gradients of the weights, as `layers` has them."""
    parts = []
    for at, size, values in _matrices(about, layers):
        whole = gradient[about.matrix[at] : about.matrix[at] + size[0] * size[1]].reshape(size)
        parts.append(whole[: values.shape[1], : values.shape[0]].T)
    parts[0] = np.concatenate((parts[0], parts.pop()), axis=1)
    found = []
    for at, (matrix, bias) in enumerate(zip(parts, layers[1::2], strict=True)):
        found.append(torch.from_numpy(np.ascontiguousarray(matrix)))
        found.append(torch.from_numpy(gradient[about.bias[at] : about.bias[at] + len(bias)].copy()))
    return found


def _chunks(starts: NDArray[np.int64], size: int) -> NDArray[np.int64]:
    """First group of each chunk, and the number of groups."""
    rows = max(_CHUNK_ROWS, int(size * _ROWS_PER_WEIGHT))
    cuts = np.searchsorted(starts, np.arange(rows, starts[-1], rows))
    return np.unique(np.concatenate(([0], cuts, [len(starts) - 1])))


class _Mlp(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, x: Tensor, shared: Tensor, groups: Groups, output: Activation, *layers: Tensor
    ) -> Tensor:
        about = _describe(x.shape[1], shared.shape[1], layers, output == "sigmoid")
        starts = groups.starts.numpy()
        places = starts, groups.of_row.numpy(), _chunks(starts, about.size)
        fixed = about, _pack(about, layers), devices.flat(x), devices.flat(shared), *places
        out = torch.empty(len(x), about.outputs)
        mlp_forward(*fixed, devices.flat(out))
        ctx.kept = (*fixed, devices.flat(out)), layers, (x.shape, shared.shape)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        (about, *fixed), layers, (x, shared) = ctx.kept
        d_x, d_shared = torch.zeros(x), torch.empty(shared)
        partial = np.zeros((len(fixed[5]) - 1, about.size), np.float32)
        given = devices.flat(grads[0])
        mlp_backward(about, *fixed, given, partial, devices.flat(d_x), devices.flat(d_shared))
        return d_x, d_shared, None, None, *_unpack(about, partial[0], layers)
