"""The CPU backend: Numba kernels behind one autograd function per image.

`pipeline` says what happens in which order. Gradients are summed in an order that does not depend
on the number of threads, so equal inputs give equal bits.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import pad

from chronoscene.errors import BackendError
from chronoscene.rasterizer.constants import VALUE_MAX
from chronoscene.rasterizer.cpu import passes as pipeline
from chronoscene.rasterizer.cpu.function import Render, Request
from chronoscene.rasterizer.cpu.simd import LANES
from chronoscene.rasterizer.recentring import recentred
from chronoscene.rasterizer.types import RasterInfo, Rasterization

__all__ = ["rasterize"]


def rasterize(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    *,
    near_plane: float,
    far_plane: float,
    eps2d: float,
    backgrounds: Tensor | None,
    render_depth: bool,
) -> Rasterization:
    """Render Gaussians; see `chronoscene.rasterizer.rasterize`. Everything is cast to float32."""
    if means.device.type != "cpu":
        raise BackendError(
            "backend",
            expected="tensors on the CPU",
            found=str(means.device),
            todo="move them with .cpu() or choose backend='auto'",
        )
    if means.dtype == torch.float64:
        means, viewmats = recentred(means, viewmats)
    if colors.shape[1] != 3 or render_depth:  # the kernel sees three channels, if these are all
        colors, opacities = _without_bad_colors(colors, opacities)
    gaussians = _prepare(means, quats, scales, opacities, colors)
    count, padded, cameras = means.shape[0], gaussians[0].shape[0], viewmats.shape[0]
    wants_grad = torch.is_grad_enabled() and any(x.requires_grad for x in gaussians)
    info = _Visible.empty(cameras, padded)
    leaf = info.means2d[:, :count].detach().requires_grad_(wants_grad)
    images, alphas, depths = [], [], []
    poses, intrinsics = viewmats.detach().double().numpy(), Ks.detach().double().numpy()
    for c in range(cameras):
        view = pipeline.make_view(
            poses[c], intrinsics[c], width, height, near_plane, far_plane, eps2d
        )
        background = None if backgrounds is None else backgrounds[c].float()
        image, alpha, weighted = Render.apply(
            *gaussians,
            _slot(leaf, c, padded) if wants_grad else None,
            background,
            Request(view, info.of(c), render_depth),
        )
        images.append(image)
        alphas.append(alpha)
        if render_depth:
            hit = alpha > 0
            depths.append(torch.where(hit, weighted / torch.where(hit, alpha, 1), 0))
    return Rasterization(
        image=_stack(images),
        alphas=_stack(alphas),
        depths=_stack(depths) if render_depth else None,
        info=RasterInfo(means2d=leaf, radii=info.radii[:, :count], depths=info.depths[:, :count]),
    )


def _stack(parts: list[Tensor]) -> Tensor:
    """Without a copy for the usual single camera."""
    return parts[0][None] if len(parts) == 1 else torch.stack(parts)


def _slot(leaf: Tensor, c: int, padded: int) -> Tensor:
    """What receives the gradient of one camera's means2d, with ``padded`` rows.

    The usual single camera gets the leaf itself: taking a part of it costs two copies on the way
    back.
    """
    part = leaf if leaf.shape[0] == 1 else leaf[c]
    missing = padded - leaf.shape[1]
    return pad(part, (0, 0, 0, missing)) if missing else part


def _without_bad_colors(colors: Tensor, opacities: Tensor) -> tuple[Tensor, Tensor]:
    """Gaussians whose colours are not finite or too large, made invisible and harmless."""
    usable = (colors.abs() < VALUE_MAX).all(dim=1)
    if bool(usable.all()):
        return colors, opacities
    return torch.where(usable[:, None], colors, 0), torch.where(usable, opacities, 0)


def _prepare(
    means: Tensor, quats: Tensor, scales: Tensor, opacities: Tensor, colors: Tensor
) -> tuple[Tensor, ...]:
    """Contiguous float32, at least `LANES` rows: added rows have opacity 0."""
    missing = max(0, LANES - means.shape[0])
    if missing:
        opacities = pad(opacities, (0, missing))
        means, quats, scales, colors = (
            pad(x, (0, 0, 0, missing)) for x in (means, quats, scales, colors)
        )
    return tuple(x.float().contiguous() for x in (means, quats, scales, opacities, colors))


@dataclass(frozen=True, slots=True)
class _Visible:
    """What the projection tells the caller. radii holds int32."""

    means2d: Tensor
    radii: Tensor
    depths: Tensor

    @classmethod
    def empty(cls, cameras: int, count: int) -> _Visible:
        return cls(
            torch.empty(cameras, count, 2),
            torch.empty(cameras, count, 2, dtype=torch.int32),
            torch.empty(cameras, count),
        )

    def of(self, c: int) -> tuple[pipeline.Array, pipeline.Array, pipeline.Array]:
        """Flat arrays of one camera for the kernel, which writes integers as float bits."""
        means2d, radii, depths = (
            self.means2d[c],
            self.radii[c].view(torch.float32),
            self.depths[c],
        )
        return means2d.numpy().reshape(-1), radii.numpy().reshape(-1), depths.numpy()
