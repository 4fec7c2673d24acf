"""Code of a photo's light, from the photo itself: five convolutions and a mean.

Source: Chen et al. 2022, "Hallucinated Neural Radiance Fields in the Wild", section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image
from torch import Tensor
from torch.nn.functional import pad, unfold

from chronoscene.fields.mlp import equal_groups, initial_layers, mlp

_FILTERS = ((7, 1), (4, 2), (4, 2), (4, 2), (4, 2))
"""Edge and stride of each convolution."""
_CHANNELS = (1, 2, 4, 4, 4)
_IGNORED = 128  # Grey in place of what a mask leaves out


def small_photo(
    photo: NDArray[np.uint8], mask: NDArray[np.bool_] | None, size: int
) -> NDArray[np.uint8]:
    """Shrink a photo to a square, what a mask ignores to grey. [H, W, 3] -> [size, size, 3]"""
    if mask is not None:
        photo = np.where(mask[..., None], photo, np.uint8(_IGNORED))
    shrunk = Image.fromarray(photo).resize((size, size), Image.Resampling.BOX)
    return np.asarray(shrunk)


def initial_encoder(channels: int, size: int, generator: torch.Generator) -> list[Tensor]:
    """Draw matrices and biases of the convolutions, and of the layer that gives the code."""
    widths = 3, *(channels * factor for factor in _CHANNELS)
    layers = []
    for (edge, _), (inputs, outputs) in zip(_FILTERS, pairwise(widths), strict=True):
        layers += initial_layers((inputs * edge * edge, outputs), generator)
    return layers + initial_layers((widths[-1], size), generator)


def encode_photos(photos: Tensor, layers: Sequence[Tensor]) -> Tensor:
    """Return the code of the light of photos. -1..1 [B, 3, S, S] -> [B, A]"""
    x = photos
    for i, (edge, stride) in enumerate(_FILTERS):
        x = torch.relu(_convolve(x, layers[2 * i : 2 * i + 2], edge, stride))
    return _each_row(x.flatten(2).mean(2), layers[-2:])


def _convolve(x: Tensor, layers: Sequence[Tensor], edge: int, stride: int) -> Tensor:
    """Convolve as a product of matrices, with equal bits for any number of threads."""
    size = x.shape[-1] // stride
    padded = pad(x, 4 * [(edge - 1) // 2], mode="reflect")
    columns = unfold(padded, edge, stride=stride).transpose(1, 2)
    rows = _each_row(columns.flatten(0, 1).contiguous(), layers)
    return rows.view(len(x), size, size, -1).permute(0, 3, 1, 2).contiguous()


def _each_row(x: Tensor, layers: Sequence[Tensor]) -> Tensor:
    groups = equal_groups(len(x), 1, x.device)
    return mlp(x, x.new_zeros(len(x), 0), groups, layers)
