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

from math import pi, sqrt
from typing import Any

import numpy as np
import torch
from numba import prange
from torch import Tensor

from chronoscene.kernels.compilation import inner, kernel
from chronoscene.training import devices

MAX_DEGREE = 3
NUM_BASES = (MAX_DEGREE + 1) ** 2

# The normalisation of each polynomial; named after degree and order.
C0 = 0.5 * sqrt(1 / pi)
_C1 = 0.5 * sqrt(3 / pi)
_C2_XY = 0.5 * sqrt(15 / pi)
_C2_ZZ = 0.25 * sqrt(5 / pi)
_C2_XX = 0.25 * sqrt(15 / pi)
_C3_3 = 0.25 * sqrt(35 / (2 * pi))
_C3_2 = 0.5 * sqrt(105 / pi)
_C3_1 = 0.25 * sqrt(21 / (2 * pi))
_C3_0 = 0.25 * sqrt(7 / pi)
_C3_22 = 0.25 * sqrt(105 / pi)

BLOCK = 512  # Rows that one task handles. Fixed, so that the result does not depend on the threads.


def dc_from_rgb(rgb: Tensor) -> Tensor:
    """Return the constant coefficient that gives a colour 0..1. [..., 3]"""
    return (rgb - 0.5) / C0


def basis(directions: Tensor, degree: int) -> Tensor:
    """Compute basis values of unit directions. [..., 3] -> [..., (degree + 1)^2]"""
    x, y, z = directions.unbind(-1)
    xx, yy, zz = x * x, y * y, z * z
    values = [torch.full_like(x, C0)]
    if degree >= 1:
        values += [-_C1 * y, _C1 * z, -_C1 * x]
    if degree >= 2:
        values += [_C2_XY * x * y, -_C2_XY * y * z, _C2_ZZ * (2 * zz - xx - yy)]
        values += [-_C2_XY * x * z, _C2_XX * (xx - yy)]
    if degree >= 3:
        values += [-_C3_3 * y * (3 * xx - yy), _C3_2 * x * y * z, -_C3_1 * y * (4 * zz - xx - yy)]
        values += [_C3_0 * z * (2 * zz - 3 * xx - 3 * yy), -_C3_1 * x * (4 * zz - xx - yy)]
        values += [_C3_22 * z * (xx - yy), -_C3_3 * x * (xx - 3 * yy)]
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
    if devices.has_kernels(means):
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
        inputs = (devices.array_of(tensor) for tensor in (sh_dc, sh_rest, means, centre))
        _forward(*inputs, degree, result.numpy())
        ctx.save_for_backward(sh_dc, sh_rest, means, centre, result)
        ctx.degree = degree
        return result

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        dc, rest, means, centre, colors = (devices.array_of(tensor) for tensor in ctx.saved_tensors)
        results = [np.empty_like(array) for array in (dc, rest, means)]
        _backward(rest, means, centre, ctx.degree, colors, devices.array_of(grads[0]), *results)
        return *(torch.from_numpy(result) for result in results), None, None


@inner(inline="always")
def _write_basis(x, y, z, degree, out):  # type: ignore[no-untyped-def]
    """Write the values without the constant one: ``out[k - 1]`` is basis k. [15]"""
    out[0], out[1], out[2] = -_C1 * y, _C1 * z, -_C1 * x
    if degree < 2:
        return
    xx, yy, zz = x * x, y * y, z * z
    out[3], out[4] = _C2_XY * x * y, -_C2_XY * y * z
    out[5] = _C2_ZZ * (2 * zz - xx - yy)
    out[6], out[7] = -_C2_XY * x * z, _C2_XX * (xx - yy)
    if degree < 3:
        return
    out[8], out[9] = -_C3_3 * y * (3 * xx - yy), _C3_2 * x * y * z
    out[10], out[11] = -_C3_1 * y * (4 * zz - xx - yy), _C3_0 * z * (2 * zz - 3 * xx - 3 * yy)
    out[12], out[13] = -_C3_1 * x * (4 * zz - xx - yy), _C3_22 * z * (xx - yy)
    out[14] = -_C3_3 * x * (xx - 3 * yy)


@inner(inline="always")
def _direction_gradient(x, y, z, degree, s):  # type: ignore[no-untyped-def]
    """``sum_k s[k] * d basis_k / d (x, y, z)``, the polynomials taken as free of |d| = 1."""
    gx, gy, gz = -_C1 * s[2], -_C1 * s[0], _C1 * s[1]
    if degree >= 2:
        gx += _C2_XY * (y * s[3] - z * s[6]) - 2 * _C2_ZZ * x * s[5] + 2 * _C2_XX * x * s[7]
        gy += _C2_XY * (x * s[3] - z * s[4]) - 2 * _C2_ZZ * y * s[5] - 2 * _C2_XX * y * s[7]
        gz += -_C2_XY * (y * s[4] + x * s[6]) + 4 * _C2_ZZ * z * s[5]
    if degree >= 3:
        xx, yy, zz = x * x, y * y, z * z
        gx += -6 * _C3_3 * x * y * s[8] + _C3_2 * y * z * s[9] + 2 * _C3_1 * x * y * s[10]
        gx += -6 * _C3_0 * x * z * s[11] - _C3_1 * (4 * zz - 3 * xx - yy) * s[12]
        gx += 2 * _C3_22 * x * z * s[13] - 3 * _C3_3 * (xx - yy) * s[14]
        gy += -3 * _C3_3 * (xx - yy) * s[8] + _C3_2 * x * z * s[9]
        gy += -_C3_1 * (4 * zz - xx - 3 * yy) * s[10] - 6 * _C3_0 * y * z * s[11]
        gy += 2 * _C3_1 * x * y * s[12] - 2 * _C3_22 * y * z * s[13] + 6 * _C3_3 * x * y * s[14]
        gz += _C3_2 * x * y * s[9] - 8 * _C3_1 * z * (y * s[10] + x * s[12])
        gz += _C3_0 * (6 * zz - 3 * xx - 3 * yy) * s[11] + _C3_22 * (xx - yy) * s[13]
    return gx, gy, gz


@inner(inline="always")
def _direction(means, n, centre):  # type: ignore[no-untyped-def]
    """Return the unit vector from the camera to a Gaussian, and 1 over their distance."""
    x, y, z = means[n, 0] - centre[0], means[n, 1] - centre[1], means[n, 2] - centre[2]
    inverse = np.float32(1.0) / np.sqrt(max(x * x + y * y + z * z, np.float32(1e-24)))
    return x * inverse, y * inverse, z * inverse, inverse


@kernel(parallel=True)
def _forward(sh_dc, sh_rest, means, centre, degree, colors):  # type: ignore[no-untyped-def]
    count, active = len(means), (degree + 1) ** 2 - 1
    for block in prange((count + BLOCK - 1) // BLOCK):
        values = np.empty(15, np.float32)
        for n in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            r = np.float32(C0) * sh_dc[n, 0] + np.float32(0.5)
            g = np.float32(C0) * sh_dc[n, 1] + np.float32(0.5)
            b = np.float32(C0) * sh_dc[n, 2] + np.float32(0.5)
            if degree > 0:
                x, y, z, _ = _direction(means, n, centre)
                _write_basis(x, y, z, degree, values)
                for k in range(active):
                    r += values[k] * sh_rest[n, k, 0]
                    g += values[k] * sh_rest[n, k, 1]
                    b += values[k] * sh_rest[n, k, 2]
            colors[n, 0] = max(r, np.float32(0.0))
            colors[n, 1] = max(g, np.float32(0.0))
            colors[n, 2] = max(b, np.float32(0.0))


@kernel(parallel=True)
def _backward(  # type: ignore[no-untyped-def]
    sh_rest, means, centre, degree, colors, grad_colors, grad_dc, grad_rest, grad_means
):
    count, active = len(means), (degree + 1) ** 2 - 1
    for block in prange((count + BLOCK - 1) // BLOCK):
        values = np.empty(15, np.float32)
        sums = np.empty(15, np.float32)
        for n in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            # A colour that was cut at 0 has no gradient.
            r = grad_colors[n, 0] if colors[n, 0] > 0 else np.float32(0.0)
            g = grad_colors[n, 1] if colors[n, 1] > 0 else np.float32(0.0)
            b = grad_colors[n, 2] if colors[n, 2] > 0 else np.float32(0.0)
            grad_dc[n, 0] = np.float32(C0) * r
            grad_dc[n, 1] = np.float32(C0) * g
            grad_dc[n, 2] = np.float32(C0) * b
            grad_means[n] = 0.0
            if degree == 0 or (r == 0.0 and g == 0.0 and b == 0.0):
                grad_rest[n] = 0.0
                continue
            x, y, z, inverse = _direction(means, n, centre)
            _write_basis(x, y, z, degree, values)
            for k in range(active):
                sums[k] = r * sh_rest[n, k, 0] + g * sh_rest[n, k, 1] + b * sh_rest[n, k, 2]
                grad_rest[n, k, 0] = values[k] * r
                grad_rest[n, k, 1] = values[k] * g
                grad_rest[n, k, 2] = values[k] * b
            for k in range(active, 15):
                grad_rest[n, k] = 0.0
            gx, gy, gz = _direction_gradient(x, y, z, degree, sums)
            along = gx * x + gy * y + gz * z
            grad_means[n, 0] = (gx - along * x) * inverse
            grad_means[n, 1] = (gy - along * y) * inverse
            grad_means[n, 2] = (gz - along * z) * inverse
