"""Projection of Gaussians in plain torch, as the peers need it: covariances and their inverses."""

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.rasterizer.scenes import Scene
from chronoscene.rasterizer.constants import CLAMP_MARGIN, EPS2D


def project(scene: Scene) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Centres [N, 2], variances of x and y [N, 2], conics [N, 3] in pixels, and depths [N]."""
    means, quats, scales = scene.gaussians[:3]
    rotation, shift, K = scene.viewmats[0, :3, :3], scene.viewmats[0, :3, 3], scene.Ks[0]
    x, y, z = (means @ rotation.T + shift).unbind(1)
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    tx = _held(x / z, fx, cx, scene.width)
    ty = _held(y / z, fy, cy, scene.height)
    axes = rotation @ _rotations(quats) * scales[:, None, :]
    a = (fx / z)[:, None] * (axes[:, 0] - tx[:, None] * axes[:, 2])
    b = (fy / z)[:, None] * (axes[:, 1] - ty[:, None] * axes[:, 2])
    xx, xy, yy = (a * a).sum(1) + EPS2D, (a * b).sum(1), (b * b).sum(1) + EPS2D
    conics = torch.stack([yy, -xy, xx], dim=1) / (xx * yy - xy * xy)[:, None]
    centres = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=1)
    return centres, torch.stack([xx, yy], dim=1), conics, z


def _held(ratio: Tensor, focal: Tensor, centre: Tensor, size: int) -> Tensor:
    margin = CLAMP_MARGIN * 0.5 * size / focal
    return ratio.clamp(-centre / focal - margin, (size - centre) / focal + margin)


def _rotations(quats: Tensor) -> Tensor:
    w, x, y, z = (quats / quats.norm(dim=1, keepdim=True)).unbind(1)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
