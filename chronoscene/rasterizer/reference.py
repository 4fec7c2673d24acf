"""The definition of the image: plain vectorised torch, any float type, differentiable by autograd.

Written to be read and checked, in the order of the equations of README.md; it shares no code with
the fast backends. Pixels are composited in square tiles only to bound memory: a Gaussian is left
out of a tile where its alpha is below the threshold on every pixel, which changes nothing.

Source: Kerbl et al. 2023 (3D Gaussian splatting), Zwicker et al. 2001 (EWA splatting); constants
and clamping follow the classic mode of gsplat.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from chronoscene.rasterizer import RasterInfo, Rasterization
from chronoscene.rasterizer.constants import (
    ALPHA_MAX,
    ALPHA_MIN,
    CLAMP_MARGIN,
    EPS2D,
    EXTENT_MAX,
    QUATERNION_MIN,
    RADIUS_MAX,
    TRANSMITTANCE_MIN,
    VALUE_MAX,
)
from chronoscene.rasterizer.inputs import Inputs

TILE = 16


@dataclass(slots=True, eq=False)
class _Projected:
    """Gaussians on the screen of one camera. M is N, or the number of visible ones."""

    means2d: Tensor  # [M, 2]
    axes: Tensor  # [M, 2, 3], the rows a, b of J M: the covariance is axes axes^T + eps2d I
    depths: Tensor  # [M]


@dataclass(slots=True, eq=False)
class _Splats:
    """Visible Gaussians of one camera from front to back. V of N."""

    means2d: Tensor  # [V, 2]
    axes: Tensor  # [V, 2, 3]
    opacities: Tensor  # [V]
    values: Tensor  # [V, D], the depth appended if asked for
    extents: Tensor  # [V, 2]
    absgrad: Tensor | None  # [N, 2], added to in the backward pass
    rows: Tensor  # [V], of N


def rasterize(inputs: Inputs) -> Rasterization:
    """Render Gaussians one camera after the other."""
    means, quats, scales, opacities, colors = inputs.gaussians
    width, height, eps2d = inputs.width, inputs.height, inputs.eps2d
    info = _new_info(means, len(inputs.viewmats), inputs.gaussians)
    absgrad = torch.zeros_like(info.means2d.detach()) if inputs.absgrad else None
    if absgrad is not None:
        info.means2d.absgrad = absgrad  # type: ignore[attr-defined]
    images, alphas, depths = [], [], []
    for c, (viewmat, K) in enumerate(zip(inputs.viewmats, inputs.Ks, strict=True)):
        camera = (viewmat, K, width, height)
        with torch.no_grad():
            everything = _project(means, quats, scales, *camera)
            extents = _extents(everything.axes, _seen(opacities, everything.axes, inputs), eps2d)
            visible = _visible(everything, extents, inputs)
            visible &= _determinants(everything.axes, eps2d) > 0
            visible &= (colors.abs() < VALUE_MAX).all(dim=-1) & (opacities < VALUE_MAX)
            visible &= quats.abs().amax(dim=-1) >= QUATERNION_MIN
            _fill_info(info, c, everything, extents, visible)
            # A stable sort: Gaussians at equal depth are drawn in the order of the input.
            order = torch.argsort(torch.where(visible, everything.depths, torch.inf), stable=True)
            index = order[: int(visible.sum())]
        projected = _project(means[index], quats[index], scales[index], *camera)
        values = colors[index]
        if inputs.render_depth:
            values = torch.cat([values, projected.depths[:, None]], dim=1)
        # The leaf has the values, the projection the gradient; both receive it in backward().
        means2d = info.means2d[c, index] + (projected.means2d - projected.means2d.detach())
        seen = _seen(opacities[index], projected.axes, inputs)
        shown = (means2d, projected.axes, seen, values, extents[index])
        splats = _Splats(*shown, None if absgrad is None else absgrad[c], index)
        image, transmittance = _composite(splats, width, height, eps2d)
        alphas.append(1 - transmittance)
        if inputs.render_depth:
            image, weighted = image[..., :-1], image[..., -1:]
            depths.append(_expected_depth(weighted, alphas[-1]))
        if inputs.backgrounds is not None:
            image = image + transmittance * inputs.backgrounds[c]
        images.append(image)
    return Rasterization(
        image=torch.stack(images),
        alphas=torch.stack(alphas),
        depths=torch.stack(depths) if inputs.render_depth else None,
        info=info,
    )


def _new_info(means: Tensor, cameras: int, inputs: tuple[Tensor, ...]) -> RasterInfo:
    """Zeros of the right shapes; ``means2d`` is a leaf that collects a gradient if any does."""
    shape = (cameras, means.shape[0])
    wants_grad = torch.is_grad_enabled() and any(x.requires_grad for x in inputs)
    return RasterInfo(
        means2d=means.new_zeros(*shape, 2).requires_grad_(wants_grad),
        radii=torch.zeros(*shape, 2, dtype=torch.int32, device=means.device),
        depths=means.new_zeros(shape),
    )


def _fill_info(
    info: RasterInfo, c: int, projected: _Projected, extents: Tensor, visible: Tensor
) -> None:
    info.means2d.data[c, visible] = projected.means2d[visible]
    info.radii[c, visible] = torch.ceil(extents[visible]).clamp(max=RADIUS_MAX).int()
    info.depths[c, visible] = projected.depths[visible]


def _rotation(quats: Tensor) -> Tensor:
    """Rotation matrices R_q of quaternions wxyz of any length. [M, 4] -> [M, 3, 3]"""
    # Scaled first, lest squares overflow or underflow; the length has no influence.
    quats = quats / quats.detach().abs().amax(dim=-1, keepdim=True)
    w, x, y, z = (quats / torch.linalg.vector_norm(quats, dim=-1, keepdim=True)).unbind(-1)
    return torch.stack(
        [
            torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
            torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
            torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
        ],
        dim=-2,
    )


def _clamped(ratio: Tensor, size: int, focal: Tensor, centre: Tensor) -> Tensor:
    """x / z or y / z, held within the image and a margin around it. [M]"""
    margin = CLAMP_MARGIN * 0.5 * size / focal
    return torch.clamp(ratio, -centre / focal - margin, (size - centre) / focal + margin)


def _project(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
) -> _Projected:
    """Centres in pixels and the axes of the Gaussians as J shows them."""
    rotation, translation = viewmat[:3, :3], viewmat[:3, 3]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]
    # p = R mu + t, m = (fx x / z + cx, fy y / z + cy).
    x, y, z = (means @ rotation.T + translation).unbind(-1)
    means2d = torch.stack([fx * x / z + cx, fy * y / z + cy], dim=-1)
    tx = z * _clamped(x / z, width, fx, cx)
    ty = z * _clamped(y / z, height, fy, cy)
    # J = d m / d p, at the position held near the image.
    zero = torch.zeros_like(z)
    jacobian = torch.stack(
        [
            torch.stack([fx / z, zero, -fx * tx / z**2], dim=-1),
            torch.stack([zero, fy / z, -fy * ty / z**2], dim=-1),
        ],
        dim=-2,
    )
    # J M with M = R R_q diag(s).
    axes = jacobian @ rotation @ _rotation(quats) * scales[:, None, :]  # [M, 2, 3]
    return _Projected(means2d, axes, z)


def _extents(axes: Tensor, opacities: Tensor, eps2d: float) -> Tensor:
    """Half width and height of the ellipse where alpha reaches the threshold; may be nan. [M, 2]"""
    level = 2 * torch.log(opacities / ALPHA_MIN)
    variances = (axes**2).sum(-1) + eps2d
    return torch.sqrt(level[:, None] * variances)


def _determinants(axes: Tensor, eps2d: float) -> Tensor:
    """Determinants of the covariances: |a x b|^2 + eps2d (|a|^2 + |b|^2) + eps2d^2, which does not
    cancel. [M]"""
    area = torch.linalg.cross(axes[:, 0], axes[:, 1])
    return (area**2).sum(-1) + eps2d * (axes**2).sum((-2, -1)) + eps2d**2


def _seen(opacities: Tensor, axes: Tensor, inputs: Inputs) -> Tensor:
    """Opacities at the centres on the screen. [M]"""
    return opacities * _compensations(axes, inputs.eps2d) if inputs.antialiased else opacities


def _compensations(axes: Tensor, eps2d: float) -> Tensor:
    """sqrt(det Sigma' / det Sigma) with Sigma' the covariance before the blur. [M]"""
    return torch.sqrt(_determinants(axes, 0.0) / _determinants(axes, eps2d))


def filter_factors(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    viewmat: Tensor,
    K: Tensor,
    width: int,
    height: int,
) -> Tensor:
    """Compute what the antialiasing filter multiplies opacities by in one view. [M]

    Without meaning for Gaussians that are not in front of the camera. Arguments as
    `chronoscene.rasterizer.rasterize`, for one camera.
    """
    projected = _project(means, quats, scales, viewmat, K, width, height)
    return _compensations(projected.axes, EPS2D)


def _visible(projected: _Projected, extents: Tensor, inputs: Inputs) -> Tensor:
    """Between the planes, finite, and with an ellipse that meets the image. [M]"""
    (u, v), (du, dv), z = projected.means2d.unbind(-1), extents.unbind(-1), projected.depths
    meets = (u + du > 0) & (u - du < inputs.width) & (v + dv > 0) & (v - dv < inputs.height)
    # Comparisons with nan are false, so a Gaussian that cannot be projected is not visible.
    sized = ((extents > 0) & (extents < EXTENT_MAX)).all(-1)
    return meets & sized & (z >= inputs.near_plane) & (z <= inputs.far_plane)


def _composite(splats: _Splats, width: int, height: int, eps2d: float) -> tuple[Tensor, Tensor]:
    """Values over nothing [H, W, D] and what light is left [H, W, 1]."""
    rows = []
    for top in range(0, height, TILE):
        tiles = [
            _composite_tile(
                splats, left, top, min(TILE, width - left), min(TILE, height - top), eps2d
            )
            for left in range(0, width, TILE)
        ]
        rows.append(torch.cat(tiles, dim=1))
    values = torch.cat(rows, dim=0)
    return values[..., :-1], values[..., -1:]


def _composite_tile(
    splats: _Splats, left: int, top: int, width: int, height: int, eps2d: float
) -> Tensor:
    """Values and transmittance of a rectangle of pixels. [height, width, D + 1]"""
    with torch.no_grad():
        low, high = splats.means2d - splats.extents, splats.means2d + splats.extents
        near = (low < low.new_tensor([left + width, top + height])) & (
            high > low.new_tensor([left, top])
        )
        index = torch.nonzero(near.all(-1))[:, 0]
    means2d = splats.means2d[index].expand(width * height, -1, -1)
    if splats.absgrad is not None and means2d.requires_grad:
        means2d.register_hook(partial(_add_absolute, splats.absgrad, splats.rows[index]))
    xs = torch.arange(left, left + width, dtype=means2d.dtype, device=means2d.device) + 0.5
    ys = torch.arange(top, top + height, dtype=means2d.dtype, device=means2d.device) + 0.5
    pixels = torch.stack(torch.meshgrid(xs, ys, indexing="xy"), dim=-1).reshape(-1, 1, 2)
    offsets = pixels - means2d  # [P, V, 2]
    distances = _distances(offsets, splats.axes[index], eps2d)
    # alpha = min(0.999, o exp(-d^T Sigma^-1 d / 2)), skipped below 1/255.
    alphas = splats.opacities[index] * torch.exp(-0.5 * distances)
    alphas = torch.where(alphas >= ALPHA_MIN, alphas.clamp(max=ALPHA_MAX), 0)
    with torch.no_grad():
        active = torch.cumprod(1 - alphas, dim=1) > TRANSMITTANCE_MIN
    alphas = torch.where(active, alphas, 0)
    after = torch.cumprod(1 - alphas, dim=1)
    ones = after.new_ones(len(after), 1)
    transmittance = torch.cat([ones, after], dim=1)
    # C = sum_i alpha_i T_i c_i, T_i = prod_{j < i} (1 - alpha_j).
    weights = alphas * transmittance[:, :-1]
    values = weights @ splats.values[index]
    return torch.cat([values, transmittance[:, -1:]], dim=1).reshape(height, width, -1)


def _add_absolute(absgrad: Tensor, rows: Tensor, gradient: Tensor) -> None:
    """Count what each pixel adds to the gradient of the centres. [N, 2], [V], [P, V, 2]"""
    absgrad.index_add_(0, rows, gradient.abs().sum(0))


def _distances(offsets: Tensor, axes: Tensor, eps2d: float) -> Tensor:
    """d^T (A A^T + eps2d I)^-1 d with A of rows a, b and d = (x, y). [P, V, 2], [V, 2, 3] -> [P, V]

    By the adjugate it is (|x b - y a|^2 + eps2d |d|^2) / determinant, again without cancelling.
    """
    across = offsets[..., :1] * axes[:, 1] - offsets[..., 1:] * axes[:, 0]
    squares = (across**2).sum(-1) + eps2d * (offsets**2).sum(-1)
    return squares / _determinants(axes, eps2d)


def _expected_depth(weighted: Tensor, alphas: Tensor) -> Tensor:
    """Weighted depth over accumulated opacity, 0 where nothing was hit. [H, W, 1]"""
    hit = alphas > 0
    return torch.where(hit, weighted / torch.where(hit, alphas, 1), 0)
