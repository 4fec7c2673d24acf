"""View-dependent colours from spherical harmonics of degree 0 to 3.

``colour = max(0, sum_k sh_coeffs[k] * basis_k(d) + 0.5)`` with ``d`` the unit direction from the
camera centre to the Gaussian. The basis is the real one with the Condon-Shortley phase, in the
order (0, 0), (1, -1), (1, 0), (1, 1), (2, -2), ...: that of the 3DGS file format.

`evaluate` runs a fused kernel, forward and backward: ours on the CPU, that of gsplat on a GPU.
`evaluate_reference` is the definition, in plain torch.

Source: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering"; the
polynomials are the textbook ones (Sloan 2008, "Stupid Spherical Harmonics Tricks").
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from chronoscene.kernels.vectors import LANES
from chronoscene.training import devices
from chronoscene.training.harmonics_kernels import (
    C0,
    C1,
    C2_XX,
    C2_XY,
    C2_ZZ,
    C3_0,
    C3_1,
    C3_2,
    C3_3,
    C3_22,
    write_colors,
    write_gradients,
)

MAX_DEGREE = 3
NUM_BASES = (MAX_DEGREE + 1) ** 2


def dc_from_rgb(rgb: Tensor) -> Tensor:
    """Return the constant coefficient that gives a colour 0..1. [..., 3]"""
    return (rgb - 0.5) / C0


def basis(directions: Tensor, degree: int) -> Tensor:
    """Compute basis values of unit directions. [..., 3] -> [..., (degree + 1)^2]"""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-C1 * y, C1 * z, -C1 * x]
    if degree >= 2:
        values += [C2_XY * x * y, -C2_XY * y * z, C2_ZZ * (2 * zz - xx - yy)]
        values += [-C2_XY * x * z, C2_XX * (xx - yy)]
    if degree >= 3:
        values += [-C3_3 * y * (3 * xx - yy), C3_2 * x * y * z, -C3_1 * y * (4 * zz - xx - yy)]
        values += [C3_0 * z * (2 * zz - 3 * xx - 3 * yy), -C3_1 * x * (4 * zz - xx - yy)]
        values += [C3_22 * z * (xx - yy), -C3_3 * x * (xx - 3 * yy)]
    return torch.stack(values, dim=-1)


def evaluate_reference(
    sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera_centre: Tensor, degree: int
) -> Tensor:
    """Compute `evaluate` in plain torch, for any floating type and device: its definition."""
    offsets = means - camera_centre
    # The square root of 0 has no gradient; a Gaussian on the camera centre is never seen.
    lengths = (offsets * offsets).sum(-1, keepdim=True).clamp_min(1e-24).sqrt()
    values = basis(offsets / lengths, degree)
    coeffs = torch.cat([sh_dc[:, None], sh_rest[:, : values.shape[-1] - 1]], dim=1)
    return ((values[..., None] * coeffs).sum(1) + 0.5).clamp_min(0.0)


def evaluate(
    sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera_centre: Tensor, degree: int
) -> Tensor:
    """Compute the colours of Gaussians as seen from a camera.

    Differentiable in everything but the camera centre. On the CPU equal bits for any number of
    threads.

    Args:
        sh_dc: Constant coefficients. float32 [N, 3]
        sh_rest: The others; those above `degree` are ignored. float32 [N, 15, 3]
        means: Centres in the training frame. float32 [N, 3]
        camera_centre: In the same frame. float32 [3]
        degree: 0 to 3.

    Returns:
        colors: At least 0, without an upper bound. float32 [N, 3]
    """
    if devices.has_kernels(means) and len(means) >= LANES:  # as many as the kernels need
        return _Evaluate.apply(sh_dc, sh_rest, means, camera_centre, degree)
    if means.is_cuda:
        return _evaluate_gsplat(sh_dc, sh_rest, means, camera_centre, degree)
    return evaluate_reference(sh_dc, sh_rest, means, camera_centre, degree)


def _evaluate_gsplat(
    sh_dc: Tensor, sh_rest: Tensor, means: Tensor, camera_centre: Tensor, degree: int
) -> Tensor:
    from chronoscene.rasterizer import gsplat_backend

    offsets = means - camera_centre
    # The kernel divides by the length; a Gaussian on the camera centre is never seen.
    offsets = torch.where((offsets == 0).all(-1, keepdim=True), 1.0, offsets)
    coeffs = torch.cat([sh_dc[:, None], sh_rest], dim=1)
    sums = gsplat_backend.spherical_harmonics(degree, offsets, coeffs)
    return (sums + 0.5).clamp_min(0.0)


class _Evaluate(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, sh_dc: Tensor, sh_rest: Tensor, means: Tensor, centre: Tensor, degree: int
    ) -> Tensor:
        result = torch.empty(len(means), 3)
        inputs = (devices.flat(tensor) for tensor in (sh_dc, sh_rest, means, centre))
        write_colors(*inputs, degree, devices.flat(result))
        ctx.save_for_backward(sh_rest, means, centre, result)
        ctx.degree = degree
        return result

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        sh_rest, means, centre, colors = ctx.saved_tensors
        results = [torch.empty(like.shape) for like in (means, sh_rest, means)]
        inputs = (devices.flat(tensor) for tensor in (sh_rest, means, centre))
        outputs = (devices.flat(tensor) for tensor in (colors, grads[0], *results))
        write_gradients(*inputs, ctx.degree, *outputs)
        return *results, None, None
