"""The tensors of a model with anchors, and how they become Gaussians.

An anchor holds offsets, scales and features; three small MLPs turn the features and the viewing
direction into opacities, shapes and colours of k Gaussians. Features may vary: beside the base
feature an anchor can have one per period, and a period can have one of its own (global).
Scaffold-GS has neither; ChronoGS has both, and says in `chronogs.model` how they are fused.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import KW_ONLY, dataclass
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.blocks import own_blocks
from chronoscene.anchors.config import HEADS, AnchorConfig
from chronoscene.anchors.decode import DecodeInputs, HeadWeights, decode, decode_active
from chronoscene.anchors.density import initial_log_scales
from chronoscene.anchors.visibility import visible_anchors
from chronoscene.errors import CheckpointError
from chronoscene.methods import View
from chronoscene.rasterizer import NEAR_PLANE
from chronoscene.training.devices import to_device
from chronoscene.training.drawing import Splats, camera_centre_tensor

PER_ANCHOR = ("offsets", "features", "log_scales")  # Trained tensors with one row per anchor
TABLES = (*PER_ANCHOR, "blocks")  # Trained tensors of which a view needs some rows
FIXED = ("anchors", "used_offsets", "block_rows")  # Tensors that are not trained
_TENSORS = ("anchors", *TABLES, "block_rows", "global_features")  # Beside the MLPs
LAYERS = HeadWeights._fields
_OUTPUTS = {"opacity": 1, "covariance": 7, "color": 3}


@dataclass(frozen=True, slots=True)
class AnchorLayout:
    """Sizes and rules that a forward pass needs; stored with every model."""

    num_periods: int
    offsets: int
    base_dim: int
    period_dim: int = 0
    global_dim: int = 0
    hidden_dim: int = 32
    fusion: str = "concat"
    """Input of the MLPs: ``concat``, features side by side; ``sum``: see `chronogs.model`."""
    direction: str = "unit"
    global_heads: tuple[str, ...] = HEADS
    """MLPs that see the global feature."""
    visibility: str = "radius"
    near_plane: float = NEAR_PLANE
    antialiased: bool = False

    @classmethod
    def of(cls, config: AnchorConfig, num_periods: int) -> AnchorLayout:
        """Make the layout of a config: take over the options that have the name of a field."""
        names = [f.name for f in dataclasses.fields(cls) if hasattr(config, f.name)]
        layout = cls(
            num_periods=num_periods,
            offsets=config.offsets_per_anchor,
            **{name: getattr(config, name) for name in names},
        )
        width = max(layout.base_dim + layout.period_dim, 1)
        return dataclasses.replace(layout, hidden_dim=config.hidden_dim or width)

    @classmethod
    def from_meta(cls, meta: Mapping[str, Any]) -> AnchorLayout:
        """Read what ``dataclasses.asdict`` stored in ``model.json``."""
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in meta.items()
        }
        known = {f.name for f in dataclasses.fields(cls)}
        if set(values) != known:
            raise CheckpointError(
                "model.json: layout",
                expected=f"the keys {', '.join(sorted(known))}",
                found=", ".join(sorted(values)) or "none",
                todo="the model is of another version: train again",
            )
        return cls(**values)


@dataclass(eq=False)
class AnchorModel:
    """Tensors of a model."""

    layout: AnchorLayout
    _: KW_ONLY
    anchors: Tensor
    """Positions in the training frame; never trained. [A, 3]"""
    offsets: Tensor
    """[A, k, 3]"""
    features: Tensor
    """Features that all periods share. [A, Fb]"""
    blocks: Tensor
    """Features that vary: one or more for each anchor. [R, Fv]"""
    block_rows: Tensor
    """Block of an anchor at a period; no two anchors share one. int64 [A, T], or [A, 0] where
    nothing but the global feature varies."""
    log_scales: Tensor
    """Columns 0..2 for the offsets, 3..5 for the Gaussians. [A, 6]"""
    global_features: Tensor
    """[T, G]"""
    heads: Mapping[str, HeadWeights]
    """Two-layer MLPs by name; ``w1`` holds only the inputs that the MLP sees."""
    used_offsets: Tensor | None = None
    """Bits of the offsets that an anchor uses; None if it uses all. int64 [A]"""

    def __len__(self) -> int:
        return len(self.anchors)

    @property
    def device(self) -> torch.device:
        return self.anchors.device

    @classmethod
    def start(
        cls,
        layout: AnchorLayout,
        config: AnchorConfig,
        anchors: NDArray[np.float32],
        generator: torch.Generator,
    ) -> Self:
        """Make the model before training. Draws the heads first, so equal layouts start equal."""
        heads: dict[str, HeadWeights] = {}
        for name in HEADS:
            inputs, outputs = cls.input_dim(layout, name), _OUTPUTS[name] * layout.offsets
            heads[name] = draw_mlp(inputs, layout.hidden_dim, outputs, generator)
        count, periods = len(anchors), layout.num_periods
        shape = (count, layout.base_dim + periods * layout.period_dim)
        features = draw_start(shape, config.feature_init, config.feature_init_scale, generator)
        blocks = features[:, layout.base_dim :].reshape(count, periods, layout.period_dim)
        rows = own_blocks(count, periods)
        shape = (layout.num_periods, layout.global_dim)
        global_features = draw_start(shape, cls.global_start(config), 1.0, generator)
        model = cls(
            layout,
            anchors=torch.from_numpy(anchors),
            offsets=torch.zeros(len(anchors), layout.offsets, 3),
            features=features[:, : layout.base_dim].contiguous(),
            blocks=blocks.flatten(0, 1).contiguous(),
            block_rows=rows if layout.period_dim else rows[:, :0],
            log_scales=torch.from_numpy(initial_log_scales(anchors)),
            global_features=global_features,
            heads=heads,
        )
        heads["opacity"] = model._switched_on()
        return model

    def _switched_on(self) -> HeadWeights:
        """Return the opacity MLP, turned round if it would begin with all Gaussians off.

        All features of a new model are alike, mostly zero. By chance, the opacities of all offsets
        are negative then, seen from most sides, and what is switched off never learns: of a
        thousand models, 300 with one offset to an anchor, 3 with five, and none with ten.
        """
        head, axes = self.heads["opacity"], torch.cat([torch.eye(3), -torch.eye(3)])
        _, _, direction, _ = self.first_layer("opacity")
        hidden = (axes @ direction.T + head.b1).relu()
        shown = (hidden @ head.w2.T + head.b2 > 0).any(dim=1)
        if shown.float().mean() >= 0.5:
            return head
        return head._replace(w2=-head.w2, b2=-head.b2)

    @classmethod
    def global_start(cls, config: AnchorConfig) -> str:
        """Return the start of global features, see `draw_start`; here that of any embedding."""
        return "gaussian"

    def tensors(self) -> dict[str, Tensor]:
        """Return everything that is stored, by name."""
        named = {name: getattr(self, name) for name in _TENSORS}
        for name, head in self.heads.items():
            named |= {f"{name}.{layer}": getattr(head, layer) for layer in LAYERS}
        if self.used_offsets is not None:
            named["used_offsets"] = self.used_offsets
        return named

    @classmethod
    def from_tensors(cls, layout: AnchorLayout, tensors: Mapping[str, Tensor]) -> Self:
        """Make the model from what `tensors` returned."""
        heads: dict[str, HeadWeights] = {
            h: HeadWeights(*(tensors[f"{h}.{n}"] for n in LAYERS)) for h in HEADS
        }
        named = {name: tensors[name] for name in _TENSORS}
        return cls(layout, **named, heads=heads, used_offsets=tensors.get("used_offsets"))

    def to(self, device: str | torch.device) -> Self:
        """Return the same model on another device."""
        moved = {name: tensor.to(device) for name, tensor in self.tensors().items()}
        return self.from_tensors(self.layout, moved)

    def requires_grad(self) -> Self:
        """Mark everything but the positions of the anchors as trained."""
        for name, tensor in self.tensors().items():
            if name not in FIXED:
                tensor.requires_grad_()
        return self

    def visible(self, view: View) -> Tensor:
        """Find the anchors that a view can see, ascending. int64 [M]"""
        by, near_plane = self.layout.visibility, self.layout.near_plane
        return visible_anchors(self.anchors, self.log_scales, view, by=by, near_plane=near_plane)

    def seen_from(self, view: View) -> tuple[Tensor, Tensor]:
        """Return camera centre [3] and indices of visible anchors [M], as `decode` takes them."""
        return camera_centre_tensor(view, self.device), self.visible(view)

    def decode(self, period_weights: Tensor, centre: Tensor, visible: Tensor) -> Splats:
        """Decode the visible anchors; arguments as those of `DecodeInputs`."""
        return decode(self.decode_inputs(period_weights, centre, visible))

    def decode_active(
        self, period_weights: Tensor, centre: Tensor, visible: Tensor | None
    ) -> tuple[Splats, Tensor]:
        """Return `decode` without Gaussians that are switched off, and the places of the others."""
        return decode_active(self.decode_inputs(period_weights, centre, visible))

    def decode_inputs(
        self, period_weights: Tensor, centre: Tensor, visible: Tensor | None
    ) -> DecodeInputs:
        """Return what `decode` reads; arguments as `DecodeInputs`."""
        opacity, covariance, color = (self._kernel_head(name) for name in HEADS)
        used = self.used_offsets
        if used is None:
            used = torch.full((len(self),), -1, device=self.device)
        return DecodeInputs(
            anchors=self.anchors,
            offsets=self.offsets,
            features=self.seen_features(centre),
            blocks=self.blocks,
            log_scales=self.log_scales,
            global_features=self.global_features,
            period_weights=period_weights,
            opacity_head=opacity,
            covariance_head=covariance,
            color_head=color,
            camera_centre=centre,
            visible=visible,
            used_offsets=used,
            block_rows=self.block_rows,
        )

    def seen_features(self, centre: Tensor) -> Tensor:
        """Return the features that all periods share, as the MLPs get them in a view. [A, F]"""
        features = self.features
        if self.layout.direction == "full":  # a second base feature that nothing trains
            features = torch.cat([features, self.anchors - centre], dim=1)
        return features

    @staticmethod
    def input_dim(layout: AnchorLayout, head: str) -> int:
        """Count the inputs of an MLP: base, period, direction, global feature side by side."""
        global_dim = layout.global_dim if head in layout.global_heads else 0
        return layout.base_dim + layout.period_dim + 3 + global_dim

    def first_layer(self, head: str) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Split ``w1`` into columns for base, period, direction and global input. [H, ·]"""
        layout, w1 = self.layout, self.heads[head].w1
        dims = [layout.base_dim, layout.period_dim, 3]
        base, period, directions, table = w1.split([*dims, w1.shape[1] - sum(dims)], dim=1)
        if head not in layout.global_heads:
            table = zero_columns(w1, layout.global_dim)
        return base, period, directions, table

    def longer_global(self, length: int, generator: np.random.Generator) -> dict[str, Tensor]:
        """Return the tensors that change if global features get more numbers, zeros at first.

        Images stay as they are. The weights are drawn as `draw_mlp` does.
        """
        added = length - self.layout.global_dim
        if added <= 0:
            return {}
        table = self.global_features
        changed = {"global_features": torch.cat([table, zero_columns(table, added)], dim=1)}
        for name in self.layout.global_heads:
            w1 = self.heads[name].w1
            bound = 1.0 / math.sqrt(w1.shape[1] + added)
            drawn = generator.uniform(-bound, bound, (len(w1), added)).astype(np.float32)
            changed[f"{name}.w1"] = torch.cat([w1, to_device(drawn, w1.device)], dim=1)
        return changed

    def _kernel_head(self, name: str) -> HeadWeights:
        """Return weights for all inputs of the kernel: zeros where the MLP does not see one."""
        layout, head = self.layout, self.heads[name]
        base, period, direction, table = self.first_layer(name)
        widths = (part.shape[1] for part in (base, period, direction, table))
        if layout.direction == "unit" and head.w1.shape[1] == sum(widths):
            return head
        if layout.direction == "full":
            parts = [base, direction, period, zero_columns(head.w1, 3), table]
        else:
            parts = [base, period, direction, table]
        return head._replace(w1=torch.cat(parts, dim=1))


def zero_columns(like: Tensor, count: int) -> Tensor:
    """Make zeros beside a matrix. [rows, count]"""
    return like.new_zeros(len(like), count)


def draw_mlp(inputs: int, hidden: int, outputs: int, generator: torch.Generator) -> HeadWeights:
    """Draw weights and biases within 1/sqrt(inputs), as usual for linear layers."""
    first, second = 1.0 / math.sqrt(max(inputs, 1)), 1.0 / math.sqrt(hidden)
    return HeadWeights(
        w1=draw_start((hidden, inputs), "uniform", first, generator),
        b1=draw_start((hidden,), "uniform", first, generator),
        w2=draw_start((outputs, hidden), "uniform", second, generator),
        b2=draw_start((outputs,), "uniform", second, generator),
    )


def draw_start(shape: Sequence[int], rule: str, scale: float, generator: torch.Generator) -> Tensor:
    """Draw the start of a tensor: ``zero``, ``uniform`` within +-scale, or ``gaussian``."""
    if rule == "zero":
        return torch.zeros(*shape)
    if rule == "uniform":
        return (2.0 * torch.rand(*shape, generator=generator) - 1.0) * scale
    return torch.randn(*shape, generator=generator) * scale
