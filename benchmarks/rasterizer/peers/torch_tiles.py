"""Plain vectorised torch in float32, tile by tile, gradients by autograd.

What one writes without a compiler: projection and binning on all Gaussians at once, compositing of
16x16 tiles with cumulative products. One Gaussian costs one number per pixel of its tiles.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.rasterizer.peers import by_autograd
from benchmarks.rasterizer.peers.projection import project
from benchmarks.rasterizer.scenes import Scene
from chronoscene.rasterizer.constants import ALPHA_MAX, ALPHA_MIN, TRANSMITTANCE_MIN

NAME = "torch"
WHAT = "vectorised torch, float32, 16x16 tiles, autograd"
TILE = 16


def make(scene: Scene) -> Callable[[bool], Tensor]:
    """Rendering of a scene, with gradients of all inputs if asked for."""
    return by_autograd(scene, lambda: render(scene)[None])


def render(scene: Scene) -> Tensor:
    """[H, W, 3]"""
    opacities, colors = scene.gaussians[3:]
    width, height = scene.width, scene.height
    centres, variances, conics, depths = project(scene)
    with torch.no_grad():
        reach = torch.sqrt(2 * torch.log(opacities / ALPHA_MIN)[:, None] * variances)
        gaussians, starts = _bin(centres, reach, depths, width, height)
    columns = -(-width // TILE)
    rows = []
    for top in range(0, height, TILE):
        tiles = []
        for left in range(0, width, TILE):
            tile = (top // TILE) * columns + left // TILE
            index = gaussians[starts[tile] : starts[tile + 1]]
            box = (left, top, min(TILE, width - left), min(TILE, height - top))
            tiles.append(_tile(centres, conics, opacities, colors, index, box))
        rows.append(torch.cat(tiles, dim=1))
    return torch.cat(rows, dim=0)


def _bin(
    means2d: Tensor, reach: Tensor, depths: Tensor, width: int, height: int
) -> tuple[Tensor, list[int]]:
    """Gaussians of each tile from front to back, and where each tile's begin."""
    tiles = torch.tensor([-(-width // TILE), -(-height // TILE)])
    low = torch.floor((means2d - reach) / TILE).long().clamp(min=0)
    high = torch.minimum(torch.floor((means2d + reach) / TILE).long() + 1, tiles)
    sizes = (high - low).clamp(min=0)
    counts = torch.where(torch.isfinite(reach).all(1) & (depths > 0), sizes.prod(1), 0)
    gaussian = torch.repeat_interleave(torch.arange(len(counts)), counts)
    place = torch.arange(len(gaussian)) - torch.repeat_interleave(counts.cumsum(0) - counts, counts)
    x = low[gaussian, 0] + place % sizes[gaussian, 0]
    y = low[gaussian, 1] + place // sizes[gaussian, 0]
    tile = y * tiles[0] + x
    order = torch.argsort(depths[gaussian], stable=True)
    order = order[torch.argsort(tile[order], stable=True)]
    starts = torch.searchsorted(tile[order], torch.arange(int(tiles.prod()) + 1))
    return gaussian[order], starts.tolist()


def _tile(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    colors: Tensor,
    index: Tensor,
    box: tuple[int, int, int, int],
) -> Tensor:
    """[height, width, 3]"""
    left, top, width, height = box
    xs = torch.arange(left, left + width) + 0.5
    ys = torch.arange(top, top + height) + 0.5
    dx = xs.repeat(height)[:, None] - means2d[index, 0]
    dy = ys.repeat_interleave(width)[:, None] - means2d[index, 1]
    a, b, c = conics[index].unbind(1)
    alphas = opacities[index] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp(max=ALPHA_MAX), 0)
    light = torch.cumprod(1 - alphas, dim=1)
    alphas = torch.where(light.detach() > TRANSMITTANCE_MIN, alphas, 0)
    before = torch.cat([light.new_ones(len(light), 1), light[:, :-1]], dim=1)
    return ((alphas * before) @ colors[index]).reshape(height, width, 3)
