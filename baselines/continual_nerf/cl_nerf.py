"""CL-NeRF as a plug-in: a field that stays, and an adaptor for what each later period changes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import torch
from torch import Tensor

from baselines.continual_nerf.config import AdaptorConfig
from baselines.continual_nerf.replay import ReplayMethod
from chronoscene.fields.compositing import truncated_exp
from chronoscene.fields.grid import encode
from chronoscene.fields.method import Drawn
from chronoscene.fields.mlp import Groups, initial_layers
from chronoscene.fields.network import SHIFT, Codes, FieldNetwork, named
from chronoscene.fields.rays import Rays
from chronoscene.methods import TrainingSet, TrainingView
from chronoscene.training import devices

_ADAPTOR = 1_004  # Number of a random draw, after the seed
_FIRST_BIAS = -2.0  # Of the mask: an adaptor begins with a share of 0.12


class AdaptorNetwork(FieldNetwork):
    """Features of the place, which adaptors of the periods replace where their masks say so.

    A geometry code has a gate for each adaptor: 1 in its period and later ones, 0 before. A colour
    code is empty, or has gates of its own.
    """

    config: AdaptorConfig
    trained_from: int = 0
    """Number of the first adaptor that learns; 0 for the field itself and all of them."""

    @classmethod
    def adaptor(
        cls, config: AdaptorConfig, number: int, generator: torch.Generator
    ) -> dict[str, Tensor]:
        """Draw the tensors of an adaptor."""
        inputs, hidden = config.expert_layout.width, config.hidden
        expert = initial_layers((inputs, hidden, hidden, config.features), generator)
        mask = initial_layers((inputs, hidden, 1), generator)
        mask[-1].fill_(_FIRST_BIAS)
        params = named(f"expert_{number}", expert, biases=False) | named(f"mask_{number}", mask)
        return params | {f"table_{number}": config.expert_layout.initial_table(generator)}

    def layers(self, name: str) -> list[Tensor]:
        found = super().layers(name)
        return found if self._learns(name) else [tensor.detach() for tensor in found]

    def encode_with(self, table: str, places: Tensor) -> Tensor:
        layout = self.config.layout if table == "table" else self.config.expert_layout
        values = self.params[table]
        return encode(places, values if self._learns(table) else values.detach(), layout)

    def _learns(self, name: str) -> bool:
        number = name.partition("_")[2]
        return int(number or 0) >= self.trained_from

    def density(self, places: Tensor, groups: Groups, geometry: Tensor) -> tuple[Tensor, Tensor]:
        """Return densities; features, and the change by the latest adaptor of a ray. [N, F + 1]"""
        none = geometry[:, :0]
        features = self.mlp("density", self.encode(places), none, groups)
        mask = features.new_zeros(len(places), 1)
        for i in range(geometry.shape[1]):
            gates = geometry[:, i : i + 1]
            # A GPU evaluates an adaptor that is not asked for rather than be asked.
            if devices.has_kernels(gates) and not bool(gates.any()):
                continue
            code = self.encode_with(f"table_{i + 1}", places)
            own = self.mlp(f"expert_{i + 1}", code, none, groups)
            share = self.mlp(f"mask_{i + 1}", code, none, groups, "sigmoid")
            gate = gates.index_select(0, groups.of_row)
            share = share * gate
            features = features + share * (own - features)
            mask = torch.where(gate > 0, share, mask)
        return truncated_exp(features[:, 0] + SHIFT), torch.cat((features, mask), dim=1)

    def values(
        self, features: Tensor, places: Tensor, groups: Groups, directions: Tensor, color: Tensor
    ) -> Tensor:
        """Return colours, and the share of change. [N, 4]"""
        if color.shape[1]:  # colours of another period
            _, features = self.density(places, groups, color)
        own, mask = features[:, :-1].contiguous(), features[:, -1:]
        return torch.cat(
            (super().values(own, places, groups, directions, color[:, :0]), mask), dim=1
        )


class CLNerf(ReplayMethod):
    """The field of the first period, an adaptor for each later one, and distillation.

    Under ``sequential`` the model so far does not change: what is shown of earlier periods stays as
    it is. Earlier views, rendered by it, are shown again as views of the new period, with weights
    that fall to zero where the adaptor says that something has changed.

    Source: Wu et al. 2023, "CL-NeRF: Continual Learning of Neural Radiance Fields for Evolving
    Scene Representation"; an approximation, see README.md beside this file.
    """

    name = "cl-nerf"
    network_class: ClassVar[type[FieldNetwork]] = AdaptorNetwork
    config: AdaptorConfig
    network: AdaptorNetwork
    trained_from = 0

    def setup(self, train: TrainingSet, *, seed: int, device: str) -> None:
        self.trained_from = 0
        super().setup(train, seed=seed, device=device)

    def initial(self, train: TrainingSet, generator: torch.Generator) -> dict[str, Tensor]:
        params = AdaptorNetwork.initial(self.config, 0, 0, generator)
        for number in range(1, train.num_periods):
            params |= AdaptorNetwork.adaptor(self.config, number, generator)
        return params

    def begin(self, params: Mapping[str, Tensor]) -> None:
        super().begin(params)
        self.network.trained_from = self.trained_from

    def extended(self, train: TrainingSet) -> dict[str, Tensor]:
        self.trained_from = train.num_periods - 1
        generator = torch.Generator().manual_seed(self.seed + _ADAPTOR * train.num_periods)
        adaptor = AdaptorNetwork.adaptor(self.config, self.trained_from, generator)
        return self.network.params | adaptor

    def replayed_view(self, view: TrainingView) -> TrainingView:
        return replace(view, period=self.train.num_periods - 1)

    def gates(self, periods: Tensor) -> Tensor:
        """Return by how much each adaptor takes part in periods. [R] -> [R, T - 1]"""
        numbers = torch.arange(int(self.meta["num_periods"]) - 1, device=periods.device)
        return (periods[:, None] - numbers).clamp(0, 1).float()

    def codes(self, rays: Rays) -> Codes:
        gates = self.gates(self.pool.periods[rays.views].double())
        return Codes(gates, gates[:, :0])

    def view_codes(self, geometry_period: float, appearance_period: float) -> Codes:
        geometry, color = (
            self.gates(torch.full((1,), period, dtype=torch.float64, device=self.device))
            for period in (geometry_period, appearance_period)
        )
        return Codes(geometry, color[:, :0] if geometry_period == appearance_period else color)

    def loss(self, drawn: Drawn, rays: Rays, progress: float) -> Tensor:
        """Return the loss; replayed rays weigh less where the new period has changed something."""
        change = drawn.values[:, 3]
        loss = super().loss(drawn, rays, progress) + self.config.change_weight * change.mean()
        if self.replayed == 0:
            return loss
        old = (rays.views < self.replayed).float()
        squares = (drawn.rgb - rays.colors).square()
        return loss - ((old * change.detach())[:, None] * squares).mean()
