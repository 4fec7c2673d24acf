"""Densification as sampling: dead Gaussians move to where live ones are, all move at random.

The set is a sample of a distribution that makes good images likely. What is added or moved must
therefore leave the image nearly as it is: N Gaussians in one place stand for the one that was
there, with the opacity and the size that `shared_opacity_and_scale` gives.

Source: Kheradmand et al. 2024, "3D Gaussian Splatting as Markov Chain Monte Carlo". Different
here: what a round moves and what it adds is drawn at once, and all of it starts without moments.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from chronoscene.gaussians.config import GaussianConfig
from chronoscene.gaussians.density import Round
from chronoscene.gaussians.model import axes_of, dot, opacities_of, scales_of

MAX_COPIES = 51
"""Largest number of Gaussians that share a place; more are treated as this many."""

MAX_OPACITY = 1 - 2.0**-22
"""Larger opacities are treated as this: an opacity of 1 cannot be shared."""

_GATE_OPACITY = 0.005  # Gaussians this faint move by half of the noise
_GATE_STEEPNESS = 100.0


def shared_opacity_and_scale(opacity: Tensor, copies: Tensor) -> tuple[Tensor, Tensor]:
    """Opacity and scale with which N equal Gaussians in one place look like one.

        o' = 1 - (1 - o)^(1/N),  s'/s = o / sum_j C(N, j) (-1)^(j-1) o'^j / sqrt(j),  j = 1..N

    The light that passes through the centre of all N is then that which passes the one, and so is
    the integral of what a line of pixels through the centre loses.

    Args:
        opacity: o, 0..1. [M]
        copies: N, at least 1; counts as `MAX_COPIES` above it. int [M]

    Returns:
        opacity: o' of each. float64 [M]
        factor: s'/s. float64 [M]

    Source: the paper's equation 9, whose double sum is the one above.
    """
    o = opacity.double().clamp_max(MAX_OPACITY)
    n = copies.clamp_max(MAX_COPIES)
    shared = -torch.expm1(torch.log1p(-o) / n)
    j = torch.arange(1, MAX_COPIES + 1, device=o.device)
    table = [[math.comb(row, column) for column in j.tolist()] for row in range(MAX_COPIES + 1)]
    binomials = torch.tensor(table, dtype=torch.float64, device=o.device)[n]
    terms = binomials * (-1.0) ** (j - 1) * shared[:, None] ** j / j.double().sqrt()
    return shared, o / terms.sum(-1)


def relocate(
    parameters: dict[str, Tensor], config: GaussianConfig, generator: torch.Generator
) -> Round:
    """One round: dead Gaussians move, and the set grows by its share until it has the maximum.

    Places are those of live Gaussians, drawn with their opacities for weights. All Gaussians of
    one place, the one that was there too, are new rows.

    Args:
        parameters: Groups by name, see `model.SHAPES`; left as they are. [N, ...]
        config: What is dead, the share and the maximum.
        generator: Draws the places.
    """
    opacity = opacities_of(parameters["logit_opacities"])
    alive = opacity > config.min_opacity
    count, dead = len(opacity), int((~alive).sum())
    growth = min(int(count * config.mcmc_growth), config.max_gaussians - count)
    draws = dead + max(growth, 0)
    if draws == 0 or dead == count:
        nothing = {name: rows[:0] for name, rows in parameters.items()}
        return Round(torch.ones_like(alive), nothing)
    weights = torch.where(alive, opacity, 0.0).double()
    drawn = _draw(weights, draws, generator)
    copies = torch.bincount(drawn, minlength=count) + 1
    is_source = copies > 1
    sources = torch.nonzero(is_source)[:, 0]
    shared, factor = shared_opacity_and_scale(opacity[sources], copies[sources])
    rows = torch.cat([sources, drawn])
    at = torch.searchsorted(sources, rows)
    new = {name: values[rows] for name, values in parameters.items()}
    new["logit_opacities"] = torch.logit(shared[at]).to(opacity.dtype)
    new["log_scales"] = new["log_scales"] + factor.log()[at, None].to(opacity.dtype)
    return Round(alive & ~is_source, new)


def _draw(weights: Tensor, count: int, generator: torch.Generator) -> Tensor:
    """Rows by their weights, with replacement. [N] -> int64 [count]"""
    ends = weights.cumsum(0)
    at = torch.rand(count, generator=generator, device=weights.device, dtype=weights.dtype)
    return torch.searchsorted(ends, at * ends[-1], right=True).clamp_max(len(ends) - 1)


def noise(
    parameters: dict[str, Tensor], rate: float, config: GaussianConfig, generator: torch.Generator
) -> Tensor:
    """Random moves of the centres after a step: the fainter a Gaussian is, the larger. [N, 3]

        rate * mcmc_noise * sigmoid(100 (0.005 - o)) * Sigma * normal(0, 1)^3

    Args:
        parameters: Groups by name, see `model.SHAPES`. [N, ...]
        rate: Learning rate of the centres in this step.
        config: Has the factor.
        generator: Of the normal numbers.
    """
    means = parameters["means"]
    normal = torch.randn(means.shape, generator=generator, device=means.device)
    gate = opacities_of(
        _GATE_STEEPNESS * (_GATE_OPACITY - opacities_of(parameters["logit_opacities"]))
    )
    axes = axes_of(parameters["quats"])
    directions = normal.unbind(-1)
    variances = scales_of(parameters["log_scales"]).square().unbind(-1)
    along = [v * dot(axis, directions) for v, axis in zip(variances, axes, strict=True)]
    moves = torch.stack([dot(along, row) for row in zip(*axes, strict=True)], dim=-1)
    moves = moves * (gate * (rate * config.mcmc_noise))[:, None]
    # A quaternion of length zero has no axes; its Gaussian is not drawn, wherever it is.
    return torch.where(moves.isfinite(), moves, 0.0)


def make_generator(device: torch.device, *key: int) -> torch.Generator:
    """Random numbers that follow from a key alone."""
    (state,) = np.random.SeedSequence(key).generate_state(1, np.uint64)
    return torch.Generator(device).manual_seed(int(state >> np.uint64(1)))
