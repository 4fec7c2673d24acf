"""Density control: which Gaussians are cloned, split and pruned, and the opacity reset.

Nothing here changes a tensor in place: a round says which rows stay and which are appended. Groups
of parameters that a method adds to those of `model.SHAPES` are copied along.

Source: Kerbl et al. 2023 (3D Gaussian Splatting), with the values of the released code.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.model import axes_of, dot, logit, opacities_of, scales_of
from chronoscene.rasterizer import RasterInfo
from chronoscene.training.devices import exp, normal
from chronoscene.training.gradients import centre_gradients, centres_count

PARTS = 2  # Gaussians that a split one becomes

Scatter = Callable[[dict[str, Tensor], GaussianConfig, np.random.Generator], None]
"""Function that turns copies of split Gaussians into their parts, in place: smaller ones at places
that the generator draws."""


class GradientStatistics:
    """Mean gradient of the projected centres over the views in which a Gaussian was seen."""

    def __init__(self, count: int, device: str | torch.device) -> None:
        self.sums = torch.zeros(count, device=device)
        """Sums of the norms. [N]"""
        self.views = torch.zeros(count, device=device)
        """Number of views. [N]"""

    def add(self, info: RasterInfo, width: int, height: int, mask: Tensor | None = None) -> None:
        """Count one view whose ``backward`` is done.

        Args:
            info: Of a call with one camera. If it has absolute gradients, these count. Gaussians
                drawn before those that are counted are not in training.
            width: Of the image in pixels.
            height: The same.
            mask: Where the photo counts: the view does not count for Gaussians whose centre is
                elsewhere in it. bool [H, W]
        """
        mine = slice(info.means2d.shape[1] - len(self.sums), None)
        gradient = centre_gradients(info)[mine]
        # Norm of d loss / d (u, v), with u and v in half image sizes: no matter the resolution.
        x, y = gradient[:, 0] * (0.5 * width), gradient[:, 1] * (0.5 * height)
        seen = (info.radii[0, mine] > 0).all(-1)
        if mask is not None:
            seen &= centres_count(info.means2d[0, mine].detach(), mask)
        self.sums += torch.where(seen, (x * x + y * y).sqrt(), 0.0)
        self.views += seen

    def mean(self) -> Tensor:
        """Mean norm; 0 where never seen. [N]"""
        return self.sums / self.views.clamp_min(1)


@dataclass(frozen=True, slots=True, eq=False)
class Round:
    """Outcome of a round of densification: the new set is the kept rows, then the new ones."""

    keep: Tensor
    """Old rows that stay; a Gaussian that was split does not. bool [N]"""
    new: dict[str, Tensor]
    """Rows to append: clones, then first parts, then second parts. They have no moments yet."""


def choose_growth(
    gradient: Tensor, max_scale: Tensor, extent: float, config: GaussianConfig
) -> tuple[Tensor, Tensor]:
    """Rows to clone and rows to split. bool [N], bool [N]

    Args:
        gradient: `GradientStatistics.mean`. [N]
        max_scale: Largest of the three scales. [N]
        extent: `GaussianTrainer.extent`.
        config: Thresholds and limit of the number.
    """
    grow = gradient >= config.gradient_threshold
    if config.grow_below and len(gradient) >= config.grow_below:
        grow = torch.zeros_like(grow)
    # Cloned or split, a row adds one Gaussian.
    room = max(config.max_gaussians - len(gradient), 0) if config.max_gaussians else len(gradient)
    if int(grow.sum()) > room:
        order = torch.where(grow, gradient, -1.0).argsort(descending=True, stable=True)
        grow = torch.zeros_like(grow)
        grow[order[:room]] = True
    small = max_scale <= config.clone_scale * extent
    return grow & small, grow & ~small


def densify(
    parameters: dict[str, Tensor],
    gradient: Tensor,
    *,
    extent: float,
    prune_large: bool,
    config: GaussianConfig,
    generator: np.random.Generator,
    scatter: Scatter,
) -> Round:
    """One round: clone, split, then prune old and new rows alike.

    Args:
        parameters: Groups by name, see `model.SHAPES`; left as they are. [N, ...]
        gradient: Mean gradient. [N]
        extent: `GaussianTrainer.extent`.
        prune_large: Whether Gaussians may be too large.
        generator: Draws the centres of the parts.
        scatter: Makes them.
    """
    largest = scales_of(parameters["log_scales"]).amax(-1)
    clone, split = choose_growth(gradient, largest, extent, config)
    parts = {
        name: rows[split].repeat(PARTS, *(1,) * (rows.dim() - 1))
        for name, rows in parameters.items()
    }
    scatter(parts, config, generator)
    new = {name: torch.cat([rows[clone], parts[name]]) for name, rows in parameters.items()}
    if int((~split).sum()) + len(new["means"]) <= config.prune_above:
        return Round(~split, new)
    keep = ~split & ~_useless(parameters, extent, prune_large, config)
    keep_new = ~_useless(new, extent, prune_large, config)
    return Round(keep, {name: rows[keep_new] for name, rows in new.items()})


def scatter_in_space(
    parts: dict[str, Tensor], config: GaussianConfig, generator: np.random.Generator
) -> None:
    """Centres are samples of N(mean, R S S^T R^T)."""
    scales = exp(parts["log_scales"].double())
    samples = scales * normal(generator, tuple(scales.shape), scales)
    axes = axes_of(parts["quats"].double())
    moves = torch.stack([dot(row, samples.unbind(-1)) for row in zip(*axes, strict=True)], dim=-1)
    # A quaternion of length zero has no axes.
    parts["means"] += torch.where(moves.isfinite(), moves, samples).float()
    parts["log_scales"] -= float(np.log(config.split_factor))


def _useless(
    parameters: dict[str, Tensor], extent: float, prune_large: bool, config: GaussianConfig
) -> Tensor:
    """Rows that are too faint or too large. bool [N]"""
    useless = opacities_of(parameters["logit_opacities"]) < config.min_opacity
    if prune_large:
        largest = scales_of(parameters["log_scales"]).amax(-1)
        useless |= largest > config.max_scale * extent
    return useless


def reset_opacities(logit_opacities: Tensor, max_opacity: float) -> Tensor:
    """Clamp opacities, given and returned as logits, to a maximum. [N]"""
    return logit_opacities.clamp_max(logit(max_opacity))
