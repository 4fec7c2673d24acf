"""Fields of the family: static density, content that changes with the time, light of each photo."""

from __future__ import annotations

import torch
from torch import Tensor

from baselines.nerf.config import NerfConfig
from chronoscene.fields.compositing import softplus, truncated_exp
from chronoscene.fields.mlp import Groups, initial_layers
from chronoscene.fields.network import SHIFT, FieldNetwork, named

TRANSIENT_OUTPUTS = 5
"""Density, colour and uncertainty of what is only in one photo."""


def time_size(config: NerfConfig) -> int:
    """Length of the code of the time."""
    sizes = {"none": 0, "frequencies": 1 + 2 * config.time_frequencies, "steps": config.time_steps}
    return sizes[config.time]


def light_size(config: NerfConfig) -> int:
    """Length of the code of a photo's light."""
    return 0 if config.appearance == "none" else config.appearance_size


class NerfNetwork(FieldNetwork):
    """Density of the place alone; colour of features, direction, time and the photo's light."""

    config: NerfConfig

    @classmethod
    def begin(cls, config: NerfConfig, generator: torch.Generator) -> dict[str, Tensor]:
        """Draw the tensors of a new field."""
        params = cls.initial(config, 0, time_size(config) + light_size(config), generator)
        if config.transient == "density":
            widths = (config.features + config.transient_size, config.hidden, TRANSIENT_OUTPUTS)
            params |= named("transient", initial_layers(widths, generator), biases=False)
        return params

    def density(self, places: Tensor, groups: Groups, geometry: Tensor) -> tuple[Tensor, Tensor]:
        """Return densities and features; of transient things, too, if rays bring their code."""
        none = geometry[:, :0]
        features = self.mlp("density", self.encode(places), none, groups)
        activate = softplus if self.config.activation == "softplus" else truncated_exp
        static = activate(features[:, 0] + SHIFT)
        if geometry.shape[1] == 0:
            return static, features
        outputs = self.mlp("transient", features, geometry, groups)
        passing = softplus(outputs[:, 0])
        # Behind the features: the share and density of what passes, and its outputs.
        total = static + passing
        share = passing / total.clamp_min(1e-9)
        return total, torch.cat((features, share[:, None], passing[:, None], outputs[:, 1:]), dim=1)

    def values(
        self, features: Tensor, places: Tensor, groups: Groups, directions: Tensor, color: Tensor
    ) -> Tensor:
        """Return colours; with transient things uncertainty and their density behind them."""
        own, more = features[:, : self.config.features], features[:, self.config.features :]
        rgb = super().values(own.contiguous(), places, groups, directions, color)
        if more.shape[1] == 0:
            return rgb
        share, passing, outputs = more[:, :1], more[:, 1:2], more[:, 2:]
        theirs = softplus(outputs)
        theirs_rgb = theirs[:, :3].clamp_max(1)
        mixed = rgb + share * (theirs_rgb - rgb)
        return torch.cat((mixed, share * theirs[:, 3:], passing), dim=1)


class ContentNetwork(NerfNetwork):
    """Content that changes with the time, and light that is applied to it (NeuSC)."""

    @classmethod
    def begin(cls, config: NerfConfig, generator: torch.Generator) -> dict[str, Tensor]:
        params = super().begin(config, generator)
        params = {name: value for name, value in params.items() if not name.startswith("color.")}
        width, hidden = config.features, config.hidden
        position = config.layout.width if config.encoding == "grid" else 0
        if position:
            params["table_content"] = config.layout.initial_table(generator)
        widths = (width + position + time_size(config), hidden, hidden)
        params |= named("content", initial_layers(widths, generator), biases=not position)
        widths = (hidden, hidden, 3)
        params |= named("content_rgb", initial_layers(widths, generator), biases=not position)
        widths = (hidden + 3 + light_size(config), hidden, 3)
        return params | named("light", initial_layers(widths, generator), biases=not position)

    def values(
        self, features: Tensor, places: Tensor, groups: Groups, directions: Tensor, color: Tensor
    ) -> Tensor:
        """Return colours in the light of a photo, and those of the content behind them. [N, 6]"""
        del directions  # as in the released configuration
        when, light = color.split((time_size(self.config), light_size(self.config)), dim=1)
        if "table_content" in self.params:
            features = torch.cat((features, self.encode_with("table_content", places)), dim=1)
        content = torch.relu(self.mlp("content", features, when, groups))
        rgb = self.mlp("content_rgb", content, when[:, :0], groups, "sigmoid")
        lit = self.mlp("light", torch.cat((content, rgb), dim=1), light, groups, "sigmoid")
        return torch.cat((lit, rgb), dim=1)
