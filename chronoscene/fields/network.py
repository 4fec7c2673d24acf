"""A field: from places, directions and codes of the period to densities and colours."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from chronoscene.fields.compositing import truncated_exp
from chronoscene.fields.config import FieldConfig
from chronoscene.fields.grid import encode
from chronoscene.fields.mlp import Activation, Groups, initial_layers, mlp
from chronoscene.training import devices
from chronoscene.training.spherical_harmonics import basis

DIRECTION_DEGREE = 3
"""Degree of the spherical harmonics of a direction: 16 numbers."""
DIRECTION_SIZE = (DIRECTION_DEGREE + 1) ** 2
SHIFT = 1.0
"""Logarithm of the density that a training starts with, per half edge of the cube."""


class Codes(NamedTuple):
    """Input that a ray brings along, besides its direction."""

    geometry: Tensor
    """[R, G]"""
    color: Tensor
    """[R, A]"""


class FieldNetwork:
    """Density of a place and the geometry code; colour of features, direction and colour code.

    Args:
        config: Sizes.
        params: All tensors by name, as `initial` gives them; they are optimised, and stored.
    """

    def __init__(self, config: FieldConfig, params: dict[str, Tensor]) -> None:
        self.config = config
        self.params = params

    @classmethod
    def initial(
        cls, config: FieldConfig, geometry: int, color: int, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Draw the tensors of a new field.

        Args:
            config: Sizes.
            geometry: Length of the geometry code.
            color: Length of the colour code.
            generator: Draws them.
        """
        grid = config.encoding == "grid"
        width = config.layout.width if grid else 3 + 6 * config.frequencies
        hidden = [config.hidden] * config.layers
        # Biases, which all places share, would be learned first, and switch hidden units off.
        widths = (width + geometry, *hidden, config.features)
        params = named("density", initial_layers(widths, generator), biases=not grid)
        inputs = config.features + DIRECTION_SIZE + color
        widths = (inputs, config.hidden, config.hidden, 3)
        params |= named("color", initial_layers(widths, generator), biases=not grid)
        return params | ({"table": config.layout.initial_table(generator)} if grid else {})

    def layers(self, name: str) -> list[Tensor]:
        """Return matrices and biases of a network; biases that it does not have are zero."""
        found: list[Tensor] = []
        while (matrix := self.params.get(f"{name}.{len(found)}")) is not None:
            bias = self.params.get(f"{name}.{len(found) + 1}")
            found += matrix, matrix.new_zeros(len(matrix)) if bias is None else bias
        return found

    def mlp(
        self, name: str, x: Tensor, shared: Tensor, groups: Groups, output: Activation = "none"
    ) -> Tensor:
        """Send rows through a network by its name."""
        return mlp(x, shared, groups, self.layers(name), output)

    def encode(self, places: Tensor) -> Tensor:
        """Return the code of each place. [N, E]"""
        if self.config.encoding == "grid":
            return self.encode_with("table", places)
        return frequency_code(4 * places - 2, self.config.frequencies)

    def encode_with(self, table: str, places: Tensor) -> Tensor:
        """Return the code of each place in a hash grid, by the name of its table."""
        return encode(places, self.params[table], self.config.layout)

    def density(self, places: Tensor, groups: Groups, geometry: Tensor) -> tuple[Tensor, Tensor]:
        """Return densities [N] and features [N, F] of places of some rays."""
        features = self.mlp("density", self.encode(places), geometry, groups)
        return truncated_exp(features[:, 0] + SHIFT), features

    def values(
        self, features: Tensor, places: Tensor, groups: Groups, directions: Tensor, color: Tensor
    ) -> Tensor:
        """Return what is summed along rays: colours 0..1, and perhaps more behind them. [N, C]"""
        shared = torch.cat((basis(directions, DIRECTION_DEGREE), color), dim=1)
        return self.mlp("color", features, shared, groups, "sigmoid")


def named(prefix: str, layers: list[Tensor], *, biases: bool = True) -> dict[str, Tensor]:
    """Name the tensors of a network, ``<prefix>.<number>``; matrices have the even numbers."""
    names = enumerate(layers)
    return {f"{prefix}.{i}": tensor for i, tensor in names if biases or i % 2 == 0}


def frequency_code(x: Tensor, count: int) -> Tensor:
    """Coordinates with sines and cosines of 2^k pi x, k < count. [N, D] -> [N, D (1 + 2 count)]

    Source: Mildenhall et al. 2020, "NeRF", equation 4.
    """
    factors = 2.0 ** torch.arange(count, device=x.device, dtype=x.dtype) * torch.pi
    angles = (x[:, None, :] * factors[:, None]).flatten(1)
    if not devices.has_kernels(x):
        return torch.cat((x, angles.sin(), angles.cos()), dim=1)
    # NumPy makes one pass, where torch may take another path at the end of a thread's share.
    waves = [torch.from_numpy(wave(angles.numpy())) for wave in (np.sin, np.cos)]
    return torch.cat((x, *waves), dim=1)
