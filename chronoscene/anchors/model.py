"""The tensors of a model with anchors, and how they become Gaussians.

An anchor holds offsets, scales and a feature; three small MLPs turn the feature, the viewing
direction and a global feature into opacities, shapes and colours of k Gaussians. ChronoGS and
Scaffold-GS differ only in the lengths of the parts: see `AnchorLayout`.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from chronoscene.anchors.config import HEADS, AnchorConfig
from chronoscene.anchors.decode.heads import Decoded, HeadWeights, decode, decode_living
from chronoscene.anchors.visibility import visible_anchors
from chronoscene.errors import CheckpointError, ConfigError
from chronoscene.methods import View
from chronoscene.rasterizer import rasterize
from chronoscene.rasterizer.types import Rasterization
from chronoscene.training.camera_tensors import camera_centre_tensor, camera_tensors

PER_ANCHOR = ("offsets", "features", "log_scales")
"""Trained tensors with one row per anchor."""

_OUTPUTS = {"opacity": 1, "covariance": 7, "color": 3}
_LAYERS = ("w1", "b1", "w2", "b2")


@dataclass(frozen=True, slots=True)
class AnchorLayout:
    """Lengths and rules that a forward pass needs; stored with every model."""

    num_periods: int
    offsets: int
    base_dim: int
    period_dim: int = 0
    global_dim: int = 0
    hidden_dim: int = 32
    fusion: str = "concat"
    """``concat``: base, period feature, direction, global feature side by side; ``sum``: the
    three features, of equal length, are added."""
    direction: str = "unit"
    direction_heads: tuple[str, ...] = HEADS
    global_heads: tuple[str, ...] = HEADS
    offset_unit: str = "anchor"
    scale_unit: str = "anchor"
    visibility: str = "radius"

    def __post_init__(self) -> None:
        parts = {n for n in (self.base_dim, self.period_dim, self.global_dim) if n}
        if self.fusion == "sum" and len(parts) > 1:
            raise ConfigError(
                "fusion=sum",
                expected="base, period and global features of one length (or 0)",
                found=f"{self.base_dim}, {self.period_dim}, {self.global_dim}",
                todo="set the three dimensions alike, or use fusion=concat",
            )

    @property
    def feature_dim(self) -> int:
        """Stored numbers per anchor: base, then one block per period."""
        return self.base_dim + self.num_periods * self.period_dim

    def input_dim(self, head: str) -> int:
        """Inputs of the first layer of an MLP."""
        direction = 3 if head in self.direction_heads else 0
        if self.fusion == "sum":
            return max(self.base_dim, self.period_dim, self.global_dim) + direction
        global_dim = self.global_dim if head in self.global_heads else 0
        return self.base_dim + self.period_dim + direction + global_dim

    @classmethod
    def of(cls, config: AnchorConfig, num_periods: int, **parts: Any) -> AnchorLayout:
        """Layout of a config; ``parts`` gives what only some methods have."""
        width = config.base_dim + int(parts.get("period_dim", 0))
        return cls(
            num_periods=num_periods,
            offsets=config.offsets_per_anchor,
            base_dim=config.base_dim,
            hidden_dim=config.hidden_dim or max(width, 1),
            direction=config.direction,
            direction_heads=tuple(config.direction_heads),
            offset_unit=config.offset_unit,
            scale_unit=config.scale_unit,
            visibility=config.visibility,
            **parts,
        )

    @classmethod
    def from_meta(cls, meta: Mapping[str, Any]) -> AnchorLayout:
        """Read what ``dataclasses.asdict`` stored in ``model.json``."""
        known = {f.name for f in dataclasses.fields(cls)}
        values: dict[str, Any] = {
            k: tuple(v) if isinstance(v, list) else v for k, v in meta.items()
        }
        if set(values) != known:
            raise CheckpointError(
                "model.json: layout",
                expected=f"the keys {', '.join(sorted(known))}",
                found=", ".join(sorted(values)) or "none",
                todo="the model is of another version: train again",
            )
        return cls(**values)


class AnchorModel:
    """Tensors of a model.

    Args:
        layout: Lengths and rules.
        anchors: Positions in the training frame; never trained. [A, 3]
        offsets: [A, k, 3]
        features: Base feature, then one block per period. [A, Fb + T * Fv]
        log_scales: Columns 0..2 for the offsets, 3..5 for the Gaussians. [A, 6]
        global_features: [T, G]
        heads: Three two-layer MLPs by name; ``w1`` holds only the inputs that the MLP sees.
    """

    def __init__(
        self,
        layout: AnchorLayout,
        *,
        anchors: Tensor,
        offsets: Tensor,
        features: Tensor,
        log_scales: Tensor,
        global_features: Tensor,
        heads: Mapping[str, HeadWeights],
    ) -> None:
        self.layout = layout
        self.anchors = anchors
        self.offsets = offsets
        self.features = features
        self.log_scales = log_scales
        self.global_features = global_features
        self.heads = dict(heads)

    def __len__(self) -> int:
        return len(self.anchors)

    @property
    def device(self) -> torch.device:
        return self.anchors.device

    @classmethod
    def start(
        cls,
        layout: AnchorLayout,
        anchors: NDArray[np.float32],
        log_scales: NDArray[np.float32],
        generator: torch.Generator,
        *,
        feature_init: str = "zero",
        feature_init_scale: float = 0.1,
        global_init: str = "gaussian",
    ) -> AnchorModel:
        """The model before training. Draws the heads first, so equal layouts start equal."""
        heads = {name: _start_head(layout, name, generator) for name in HEADS}
        count = len(anchors)
        features = _draw((count, layout.feature_dim), feature_init, feature_init_scale, generator)
        table = _draw((layout.num_periods, layout.global_dim), global_init, 1.0, generator)
        return cls(
            layout,
            anchors=torch.from_numpy(anchors),
            offsets=torch.zeros(count, layout.offsets, 3),
            features=features,
            log_scales=torch.from_numpy(log_scales),
            global_features=table,
            heads=heads,
        )

    def tensors(self) -> dict[str, Tensor]:
        """Everything that is stored, by name."""
        named = {name: getattr(self, name) for name in ("anchors", *PER_ANCHOR, "global_features")}
        for head in HEADS:
            named |= {f"{head}.{layer}": getattr(self.heads[head], layer) for layer in _LAYERS}
        return named

    @classmethod
    def from_tensors(cls, layout: AnchorLayout, tensors: Mapping[str, Tensor]) -> AnchorModel:
        """Inverse of `tensors`."""
        heads = {h: HeadWeights(*(tensors[f"{h}.{n}"] for n in _LAYERS)) for h in HEADS}
        named = {name: tensors[name] for name in ("anchors", *PER_ANCHOR, "global_features")}
        return cls(layout, **named, heads=heads)

    def to(self, device: str | torch.device) -> AnchorModel:
        """The same model on another device."""
        moved = {name: tensor.to(device) for name, tensor in self.tensors().items()}
        return AnchorModel.from_tensors(self.layout, moved)

    def requires_grad(self, required: bool = True) -> AnchorModel:
        """Mark everything but the anchors' positions as trained, or as not."""
        for name, tensor in self.tensors().items():
            if name != "anchors":
                tensor.requires_grad_(required)
        return self

    def visible(self, view: View) -> NDArray[np.int64]:
        """Anchors that a view can see, ascending. [M]"""
        anchors, log_scales = self.anchors.cpu().numpy(), self.log_scales.detach().cpu().numpy()
        return visible_anchors(anchors, log_scales, view, by=self.layout.visibility)

    def decode(self, period_weights: Tensor, centre: Tensor, visible: Tensor) -> Decoded:
        """Gaussians of the visible anchors, in their order.

        Args:
            period_weights: Weights of the periods' features, usually with the sum 1. [T]
            centre: Camera centre that gives the viewing direction. [3]
            visible: Ascending indices, int64. [M]
        """
        inputs, base_dim = self._decode_arguments(period_weights, centre, visible)
        return decode(*inputs, base_dim=base_dim, period_dim=self.layout.period_dim)

    def decode_living(
        self, period_weights: Tensor, centre: Tensor, visible: Tensor
    ) -> tuple[Decoded, Tensor]:
        """`decode` without the Gaussians that are switched off.

        Returns:
            decoded: The L Gaussians with an opacity above 0.
            positions: Their places in the output of `decode`, ascending. int64 [L]
        """
        inputs, base_dim = self._decode_arguments(period_weights, centre, visible)
        return decode_living(*inputs, base_dim=base_dim, period_dim=self.layout.period_dim)

    def _decode_arguments(
        self, period_weights: Tensor, centre: Tensor, visible: Tensor
    ) -> tuple[tuple[Any, ...], int]:
        """What both functions above hand to the kernels, and the length of the base feature."""
        layout, features, base_dim = self.layout, self.features, self.layout.base_dim
        if layout.direction == "full":  # a second base feature that nothing trains
            offset = self.anchors - centre
            features = torch.cat([features[:, :base_dim], offset, features[:, base_dim:]], dim=1)
            base_dim += 3
        tensors = (self.anchors, self.offsets, features, self._scales_in_use())
        heads = [self._kernel_head(name) for name in HEADS]
        return (*tensors, self.global_features, period_weights, *heads, centre, visible), base_dim

    def _scales_in_use(self) -> Tensor:
        """Log-scales with zeros where a rule says that the frame's unit counts. [A, 6]"""
        rules = (self.layout.offset_unit, self.layout.scale_unit)
        if rules == ("anchor", "anchor"):
            return self.log_scales
        zeros = torch.zeros_like(self.log_scales[:, :3])
        halves = (self.log_scales[:, :3], self.log_scales[:, 3:])
        kept = [h if r == "anchor" else zeros for h, r in zip(halves, rules, strict=True)]
        return torch.cat(kept, dim=1)

    def _kernel_head(self, name: str) -> HeadWeights:
        """Weights with the first layer in the kernel's order: base, period, direction, global.

        Inputs that a head does not see get zero columns; features that are added instead of put
        side by side share their columns, which is the same function.
        """
        layout, head = self.layout, self.heads[name]
        sees_direction = name in layout.direction_heads
        sees_global = name in layout.global_heads
        plain = layout.fusion == "concat" and layout.direction == "unit"
        if plain and sees_direction and sees_global:
            return head
        w1 = head.w1
        dims = (layout.base_dim, layout.period_dim, layout.global_dim)
        feature_dim = max(dims) if layout.fusion == "sum" else dims[0] + dims[1]
        direction = w1[:, feature_dim : feature_dim + 3] if sees_direction else _zeros(w1, 3)
        if layout.fusion == "sum":
            base, period, table = (w1[:, : feature_dim if n else 0] for n in dims)
        else:
            base, period = w1[:, : dims[0]], w1[:, dims[0] : feature_dim]
            table = w1[:, w1.shape[1] - dims[2] :] if sees_global else w1[:, :0]
        if not sees_global:
            table = _zeros(w1, dims[2])
        if layout.direction == "full":
            parts = [base, direction, period, _zeros(w1, 3), table]
        else:
            parts = [base, period, direction, table]
        return HeadWeights(torch.cat(parts, dim=1), head.b1, head.w2, head.b2)


def draw(
    decoded: Decoded,
    view: View,
    background: Tensor,
    *,
    render_depth: bool = False,
    check_finite: bool = True,
) -> Rasterization:
    """Rasterize decoded Gaussians."""
    viewmats, Ks = camera_tensors(view, decoded.means.device)
    return rasterize(
        decoded.means,
        decoded.quats,
        decoded.scales,
        decoded.opacities,
        decoded.colors,
        viewmats,
        Ks,
        view.width,
        view.height,
        backgrounds=background[None],
        render_depth=render_depth,
        check_finite=check_finite,
    )


@torch.no_grad()
def draw_model(
    model: AnchorModel,
    view: View,
    background: Tensor,
    geometry_weights: Tensor,
    appearance_weights: Tensor | None = None,
) -> Rasterization:
    """Render a view, with depth.

    Args:
        model: What to render.
        view: The camera.
        background: [3]
        geometry_weights: Period weights of opacities and shapes. [T]
        appearance_weights: Period weights of colours, where they differ. [T]
    """
    visible = torch.from_numpy(model.visible(view)).to(model.device)
    centre = camera_centre_tensor(view, model.device)
    decoded, positions = model.decode_living(geometry_weights, centre, visible)
    if appearance_weights is not None:
        colors = model.decode(appearance_weights, centre, visible).colors
        decoded = decoded._replace(colors=colors[positions])
    return draw(decoded, view, background, render_depth=True)


def _zeros(like: Tensor, columns: int) -> Tensor:
    return like.new_zeros(len(like), columns)


def _draw(shape: Sequence[int], rule: str, scale: float, generator: torch.Generator) -> Tensor:
    if rule == "zero":
        return torch.zeros(*shape)
    if rule == "uniform":
        return (2.0 * torch.rand(*shape, generator=generator) - 1.0) * scale
    return torch.randn(*shape, generator=generator) * scale


def _start_head(layout: AnchorLayout, name: str, generator: torch.Generator) -> HeadWeights:
    """Uniform within 1/sqrt(inputs) for weights and biases: the usual start of a linear layer."""
    inputs, hidden = layout.input_dim(name), layout.hidden_dim
    outputs = _OUTPUTS[name] * layout.offsets
    w1, w2 = 1.0 / math.sqrt(max(inputs, 1)), 1.0 / math.sqrt(hidden)
    shapes = ((hidden, inputs), (hidden,), (outputs, hidden), (outputs,))
    bounds = (w1, w1, w2, w2)
    drawn = (_draw(s, "uniform", b, generator) for s, b in zip(shapes, bounds, strict=True))
    return HeadWeights(*drawn)
