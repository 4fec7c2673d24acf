"""The networks of GS-W: one reads feature maps and visibility from a photo, one makes colours.

Their tensors are kept by name beside the sizes, as the model stores and trains them.

Source: Zhang et al. 2024, and facts about the released code; README.md says what differs.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from math import prod, sqrt

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d, conv_transpose2d, interpolate, linear, max_pool2d, relu

from chronoscene.training.spherical_harmonics import C0, NUM_BASES

ENCODERS: dict[str, tuple[int, ...]] = {"resnet18": (64, 64, 128, 256, 512), "small": (16, 32, 64)}
"""Channels of the stages; each halves the resolution, the first that of the photo."""
MAPS = 3
"""Feature maps: one that Gaussians are projected into, and free ones before it."""
INTRINSIC = 3 * NUM_BASES
"""Numbers of a Gaussian's own feature, kept as spherical harmonics would be."""

_STREAM = 6  # Keeps the networks apart from other draws of the same seed

Tensors = Mapping[str, Tensor]


@dataclass(frozen=True, slots=True)
class Networks:
    """Sizes of the networks."""

    encoder: str
    """One of `ENCODERS`."""
    map_channels: int
    width: int
    """Units of the first layer of the colour network."""
    frequencies: int
    position_unit: float
    """Positions are encoded as multiples of it, in units of the training frame."""
    from_constant: bool
    """True if colours are differences to the constant colour."""

    @property
    def dynamic(self) -> int:
        """Numbers that a Gaussian reads from a photo."""
        return MAPS * self.map_channels

    def layers(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each weight of the colour network."""
        w = self.width
        last = 3 * w // 8
        inputs = 3 + 6 * self.frequencies + self.dynamic + INTRINSIC
        chains = {
            "encoder": (inputs, w, 3 * w // 4, w // 2, last),
            "decoder": (last + INTRINSIC, last, last, last),
            "head": (last + 3, last, 3),
        }
        return {
            f"color.{chain}.{i}": (after, before)
            for chain, sizes in chains.items()
            for i, (before, after) in enumerate(pairwise(sizes))
        }

    def filters(self) -> dict[str, tuple[int, ...]]:
        """Name and shape of each filter of the network that reads photos; ``up`` are transposed."""
        channels, resnet = ENCODERS[self.encoder], self.encoder == "resnet18"
        shapes: dict[str, tuple[int, ...]] = {}
        for i, (before, after) in enumerate(pairwise((3, *channels))):
            if i == 0 or not resnet:
                size = 7 if resnet else 3
                shapes[f"photo.down.{i}"] = (after, before, size, size)
                continue
            for j, inputs in enumerate((before, after)):
                shapes[f"photo.block.{i}.{j}.first"] = (after, inputs, 3, 3)
                shapes[f"photo.block.{i}.{j}.second"] = (after, after, 3, 3)
            if before != after:
                shapes[f"photo.shortcut.{i}"] = (after, before, 1, 1)
        for i, (after, before) in enumerate(pairwise(channels)):
            shapes[f"photo.up.{i}"] = (before, after, 2, 2)
            shapes[f"photo.join.{i}"] = (after, 2 * after, 3, 3)
        shapes["photo.maps"] = (self.dynamic, channels[0], 1, 1)
        tops = channels[: -min(len(channels), 4) - 1 : -1]
        for i, (before, after) in enumerate(pairwise(tops)):
            shapes[f"photo.see.up.{i}"] = (before, after, 2, 2)
        shapes["photo.see.last"] = (1, tops[-1], 1, 1)
        return shapes


def start_networks(networks: Networks, seed: int) -> dict[str, Tensor]:
    """Tensors of the networks before training, float32 on the CPU.

    Filters are normal after He et al. 2015, but the second of each residual block is zero, so that
    the block first passes on what it gets; layers are normal after Glorot and Bengio 2010, and the
    last one is zero if it gives a difference. Biases are zero.
    """
    generator = np.random.default_rng((seed, _STREAM))
    tensors = {}
    for name, shape in {**networks.filters(), **networks.layers()}.items():
        if name.startswith("photo."):
            transposed = ".up." in name
            inputs = shape[0] if transposed else prod(shape[1:])
            scale = 0.0 if name.endswith(".second") else sqrt(2 / inputs)
            outputs = shape[1] if transposed else shape[0]
        else:
            zero = networks.from_constant and name == "color.head.1"
            scale, outputs = 0.0 if zero else sqrt(2 / sum(shape)), shape[0]
        values = generator.standard_normal(shape, np.float32) * np.float32(scale)
        tensors[f"{name}.weight"] = torch.from_numpy(values)
        tensors[f"{name}.bias"] = torch.zeros(outputs)
    return tensors


def read_photo(photo: Tensor, tensors: Tensors, networks: Networks) -> tuple[Tensor, list[Tensor]]:
    """Feature maps of a photo, and what the encoder saw in it on the way.

    Args:
        photo: -1..1. [1, 3, H, W]
        tensors: Those of the networks.
        networks: Their sizes.

    Returns:
        maps: The free ones, then the one to project into, at half the resolution. [3, C, h, w]
        stages: Of the encoder, from large to small.
    """
    stages, x = [], photo
    for i in range(len(ENCODERS[networks.encoder])):
        if f"photo.down.{i}.weight" in tensors:
            x = relu(_conv(tensors, f"photo.down.{i}", x, stride=2))
        else:
            x = _residual_stage(tensors, i, max_pool2d(x, 3, 2, 1) if i == 1 else x)
        stages.append(x)
    for i in reversed(range(len(stages) - 1)):
        skip = stages[i]
        up = _up(tensors, f"photo.up.{i}", x)[..., : skip.shape[2], : skip.shape[3]]
        x = relu(_conv(tensors, f"photo.join.{i}", torch.cat([up, skip], 1)))
    maps = _conv(tensors, "photo.maps", x)
    return maps.reshape(MAPS, networks.map_channels, *maps.shape[2:]), stages


def see(stages: list[Tensor], tensors: Tensors, height: int, width: int) -> Tensor:
    """Visibility of the scene in a photo, 0..1, from the stages of `read_photo`. [height, width]"""
    x, i = stages[-1], 0
    while f"photo.see.up.{i}.weight" in tensors:
        x, i = relu(_up(tensors, f"photo.see.up.{i}", x)), i + 1
    seen = torch.sigmoid(_conv(tensors, "photo.see.last", x))
    return interpolate(seen, (height, width))[0, 0]


def _residual_stage(tensors: Tensors, stage: int, x: Tensor) -> Tensor:
    """Two blocks of two convolutions; the first of the second stage and on halves the size."""
    for block in range(2):
        stride = 2 if block == 0 and stage > 1 else 1
        inner = relu(_conv(tensors, f"photo.block.{stage}.{block}.first", x, stride=stride))
        if stride == 2:
            x = _conv(tensors, f"photo.shortcut.{stage}", x, stride=2)
        x = relu(x + _conv(tensors, f"photo.block.{stage}.{block}.second", inner))
    return x


def _conv(tensors: Tensors, name: str, x: Tensor, *, stride: int = 1) -> Tensor:
    weight = tensors[f"{name}.weight"]
    return conv2d(x, weight, tensors[f"{name}.bias"], stride, weight.shape[-1] // 2)


def _up(tensors: Tensors, name: str, x: Tensor) -> Tensor:
    return conv_transpose2d(x, tensors[f"{name}.weight"], tensors[f"{name}.bias"], 2)


def colors_of(
    means: Tensor,
    intrinsic: Tensor,
    dynamic: Tensor,
    camera_centre: Tensor,
    tensors: Tensors,
    networks: Networks,
) -> Tensor:
    """Colours of Gaussians, not bounded. [N, 3]

    With e the encoding of the mean, f the intrinsic and d the dynamic feature, v the unit vector
    from the camera to the mean, and chains of linear layers with ReLU between them,

        h = encoder(e, d, f),  color = head(decoder(h, f), v),

    to which the constant colour of f is added where differences are learned.

    Args:
        means: Centres in the training frame. [N, 3]
        intrinsic: Features of their own, f. [N, 48]
        dynamic: What they read from a photo, d. [N, D]
        camera_centre: In the training frame. [3]
        tensors: Those of the colour network.
        networks: Sizes.
    """
    means_of_unit = means / networks.position_unit
    octaves = [means_of_unit * 2.0**k for k in range(networks.frequencies)]
    encoding = [means_of_unit, *(wave(x) for x in octaves for wave in (torch.sin, torch.cos))]
    offsets = means - camera_centre
    # The square root of 0 has no gradient; a Gaussian on the camera centre is never seen.
    lengths = (offsets * offsets).sum(-1, keepdim=True).clamp_min(1e-24).sqrt()
    hidden = _chain(tensors, "encoder", torch.cat([*encoding, dynamic, intrinsic], 1))
    hidden = _chain(tensors, "decoder", torch.cat([hidden, intrinsic], 1))
    colors = _chain(tensors, "head", torch.cat([hidden, offsets / lengths], 1))
    return colors + (C0 * intrinsic[:, :3] + 0.5) if networks.from_constant else colors


def _chain(tensors: Tensors, name: str, x: Tensor) -> Tensor:
    i = 0
    while f"color.{name}.{i}.weight" in tensors:
        x = relu(x) if i else x
        x = linear(x, tensors[f"color.{name}.{i}.weight"], tensors[f"color.{name}.{i}.bias"])
        i += 1
    return x
