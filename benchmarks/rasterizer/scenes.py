"""Scenes of Gaussians for benchmarks."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

SIZES = ((20_000, 256, 256), (100_000, 400, 300), (200_000, 800, 600), (1_000_000, 1600, 1200))
"""Gaussians, width, height."""


@dataclass(frozen=True)
class Scene:
    """Arguments of one rendering, and the gradient that comes back from a loss."""

    gaussians: tuple[Tensor, Tensor, Tensor, Tensor, Tensor]
    """means, quats, scales, opacities, colors"""
    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    image_grad: Tensor

    def drop_gradients(self) -> None:
        """Remove the gradients of all inputs."""
        for x in self.gaussians:
            x.grad = None

    def to(self, device: str) -> Scene:
        """A copy on another device."""
        return replace(
            self,
            gaussians=tuple(x.detach().to(device).requires_grad_() for x in self.gaussians),
            viewmats=self.viewmats.to(device),
            Ks=self.Ks.to(device),
            image_grad=self.image_grad.to(device),
        )


def surfaces(count: int, width: int, height: int, seed: int = 0) -> Scene:
    """Flat Gaussians on eight overlapping spheres, as large as the distance between them."""
    g = np.random.default_rng(seed)
    spheres = 8
    centres = g.uniform(-1, 1, (spheres, 3)) * [1.2, 0.9, 0.6] + [0, 0, 4]
    radii = g.uniform(0.4, 1.0, spheres)
    which = g.integers(0, spheres, count)
    directions = g.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    spacing = np.sqrt(4 * np.pi * radii[which] ** 2 / (count / spheres))
    scales = 0.9 * spacing[:, None] * np.exp(g.normal(0, 0.4, (count, 3))) * [1, 1, 0.5]
    focal = 1.1 * width
    arrays = (
        centres[which] + directions * radii[which, None],
        g.normal(size=(count, 4)),
        scales,
        g.uniform(0.1, 0.99, count),
        g.uniform(0, 1, (count, 3)),
    )
    return Scene(
        tuple(torch.tensor(x, dtype=torch.float32).requires_grad_() for x in arrays),
        torch.eye(4)[None],
        torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]]),
        width,
        height,
        torch.tensor(g.normal(size=(1, height, width, 3)), dtype=torch.float32),
    )
