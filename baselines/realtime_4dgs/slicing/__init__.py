"""Gaussians in space and time as the Gaussians in space that they are at one time.

In: the groups of `SHAPES`, and a time. Out: groups as of `chronoscene.gaussians.model.SHAPES`. On
the CPU `slice_at` runs the kernels beside this file; `slice_reference` is the definition, in plain
torch, and what a GPU runs.

A position and a time are a quaternion: (x, y, z) is its imaginary part and t its real part. A pair
of unit quaternions turns it into ``left * it * conj(right)``, and every rotation in four dimensions
is such a pair. With two equal ones time stays as it is, and space is turned as by that quaternion.

What is left of a Gaussian at a time has a covariance, and the rasterizer takes rotations and
scales, so its principal axes are found, by Jacobi rotations. Where two axes are equally long, how
the covariance would turn them is not seen by a gradient of rotations and scales, so what goes
through a pair of axes fades below a relative difference of their variances of `TWIN_AXES`.

Source: Yang et al. 2024, "Real-time Photorealistic Dynamic Scene Representation and Rendering with
4D Gaussian Splatting".
"""

from __future__ import annotations

from collections.abc import Mapping
from math import pi

import torch
from torch import Tensor

from baselines.realtime_4dgs.slicing.function import OUTPUTS, Slice
from baselines.realtime_4dgs.slicing.kernels import ORTHOGONAL, SWEEPS, TWIN_AXES, VARIANCES_AWAY
from chronoscene.gaussians import model
from chronoscene.gaussians.model import axes_of, dot
from chronoscene.training import devices

ORDERS = 2
"""Orders of the waves of colours in time, beside the constant term."""

SHAPES: dict[str, tuple[int, ...]] = {
    **model.SHAPES,
    "right_quats": (4,),
    "time_means": (),
    "log_time_scales": (),
    "waves_dc": (ORDERS, 3),
    "waves_rest": (ORDERS, model.NUM_BASES - 1, 3),
}
"""Groups of parameters: name to the shape of one row. ``quats`` is the left quaternion."""


def slice_at(
    parameters: Mapping[str, Tensor], time: float, *, cycle: float, order: int
) -> dict[str, Tensor]:
    """Slice Gaussians in space and time at one time, before the activations.

    With M = R S, its rows X of space and tau of time, dt = t - mu_t:

        w = exp(-dt^2 / (2 |tau|^2)), v = X tau^T / |tau|^2
        mean = mu + v dt, covariance = Y Y^T with Y = X - v tau, opacity = sigmoid(o) w
        coefficients = sh + sum_k cos(2 pi k dt / cycle) waves[k]

    A Gaussian with a w of 0.05 or less is transparent, and only its mean and its constant colours
    have a gradient. Differentiable in all groups. On the CPU equal bits for any number of
    threads.

    Args:
        parameters: Groups of `SHAPES`.
        time: t.
        cycle: Length of the longest wave of colours.
        order: Of the shortest wave that counts, 0 to `ORDERS`.
    """
    if not devices.has_kernels(*parameters.values()):
        return slice_reference(parameters, time, cycle=cycle, order=order)
    groups = (parameters[name] for name in SHAPES)
    return dict(zip(OUTPUTS, Slice.apply(time, cycle, order, *groups), strict=True))


def slice_reference(
    parameters: Mapping[str, Tensor], time: float, *, cycle: float, order: int
) -> dict[str, Tensor]:
    """The definition of `slice_at`, in plain torch, for any floating type and device."""
    p = parameters
    left, right = (_unit(p[name].double()) for name in ("quats", "right_quats"))
    # Seen in axes that the right quaternion turns, the pair is one product from the left.
    log_scales = torch.cat([p["log_scales"], p["log_time_scales"][:, None]], dim=-1).double()
    back = _conjugate(right)
    M = _left_matrix(_product(back, left)) * log_scales.exp()[:, None]
    X, tau = M[:, :3], M[:, 3]
    dt, variance = time - p["time_means"].double(), tau.square().sum(-1)
    alive = dt.square() < VARIANCES_AWAY * variance
    variance = torch.where(alive, variance, 1.0)
    v = torch.where(alive[:, None], (X * tau[:, None]).sum(-1) / variance[:, None], 0.0)
    Y = X - v[:, :, None] * tau[:, None]
    Y = torch.where(alive[:, None, None], Y, torch.eye(3, 4, dtype=Y.dtype, device=Y.device))
    variances, turn = _principal_axes(Y)
    moves = _product(_product(right, torch.cat([0 * dt[:, None], v * dt[:, None]], dim=-1)), back)
    log_w = torch.where(alive, -0.5 * dt.square() / variance, 0.0)
    o = p["logit_opacities"].double()
    # The logit of sigmoid(o) w.
    logits = o + log_w - torch.log1p(o.exp() * -torch.expm1(log_w))
    quats = _product(right, turn)
    orders = torch.arange(1, order + 1, device=dt.device)
    waves = torch.where(alive[:, None], torch.cos(2 * pi / cycle * orders * dt[:, None]), 0.0)
    waves = waves.to(p["waves_dc"].dtype)[:, :, None]
    return {
        "means": (p["means"].double() + moves[:, 1:]).to(p["means"].dtype),
        "log_scales": (0.5 * variances.log()).to(p["log_scales"].dtype),
        "quats": torch.where(alive[:, None], quats, quats.detach()).to(p["quats"].dtype),
        "logit_opacities": torch.where(alive, logits, -torch.inf).to(p["logit_opacities"].dtype),
        "sh_dc": p["sh_dc"] + (waves * p["waves_dc"][:, :order]).sum(1),
        "sh_rest": p["sh_rest"] + (waves[..., None] * p["waves_rest"][:, :order]).sum(1),
    }


def turned(left: Tensor, right: Tensor, vectors: Tensor) -> Tensor:
    """Rotate vectors in (x, y, z, t) by pairs of quaternions of any length. [N, 4]"""
    turn = _product(_product(_unit(left), vectors.roll(1, -1)), _conjugate(_unit(right)))
    return turn.roll(-1, -1)


def _principal_axes(Y: Tensor) -> tuple[Tensor, Tensor]:
    """Variances along the principal axes of Y Y^T [N, 3], and their rotation [N, 4].

    To autograd, what Jacobi found is a constant; what that left to do, to first order, is not, and
    turns with the covariance.
    """
    turn = _jacobi(Y.detach())
    rows = [dot([x[:, None] for x in axis], Y.unbind(1)) for axis in axes_of(turn)]
    variances = torch.stack([(row * row).sum(-1) for row in rows], dim=-1)
    omega = [torch.ones_like(variances[:, 0])]
    for i, j in ((1, 2), (2, 0), (0, 1)):
        a, b = variances[:, i].detach(), variances[:, j].detach()
        omega.append(0.5 * (rows[i] * rows[j]).sum(-1) * _reciprocal(a, b))
    return variances, _product(turn, torch.stack(omega, dim=-1))


def _reciprocal(a: Tensor, b: Tensor) -> Tensor:
    """1 / (a - b), but 0 where they are equal."""
    return (a - b) / ((a - b).square() + (TWIN_AXES * (a + b)).square())


def _jacobi(Y: Tensor) -> Tensor:
    """Rotation whose inverse makes the rows of Y orthogonal to each other. [N, 3, 4] -> [N, 4]"""
    rows = list(Y.unbind(1))
    turn = torch.zeros_like(Y[:, 0])
    turn[:, 0] = 1.0
    for k, i, j in ((0, 1, 2), (1, 2, 0), (2, 0, 1)) * SWEEPS:
        alpha, beta = rows[i].square().sum(-1), rows[j].square().sum(-1)
        gamma = (rows[i] * rows[j]).sum(-1)
        zeta = (beta - alpha) / (2 * gamma)
        tangent = -torch.copysign(1 / (zeta.abs() + (1 + zeta * zeta).sqrt()), zeta)
        tangent = torch.where(gamma.square() > ORTHOGONAL * alpha * beta, tangent, 0.0)
        c = (1 + tangent * tangent).rsqrt()
        s = c * tangent
        rows[i], rows[j] = (
            c[:, None] * rows[i] + s[:, None] * rows[j],
            c[:, None] * rows[j] - s[:, None] * rows[i],
        )
        step = torch.zeros_like(turn)
        step[:, 0] = ((1 + c) / 2).sqrt()
        step[:, 1 + k] = s / (2 * step[:, 0])
        turn = _product(turn, step)
    return turn


def _unit(quats: Tensor) -> Tensor:
    """Normalise quaternions; one of length zero stays as it is, and makes a Gaussian that is
    nowhere in time."""
    return quats / quats.square().sum(-1, keepdim=True).clamp_min(1e-60).sqrt()


def _conjugate(quats: Tensor) -> Tensor:
    return torch.cat([quats[:, :1], -quats[:, 1:]], dim=-1)


def _product(left: Tensor, right: Tensor) -> Tensor:
    """Product of quaternions wxyz. [N, 4]"""
    w, x, y, z = left.unbind(-1)
    a, b, c, d = right.unbind(-1)
    return torch.stack(
        [
            w * a - x * b - y * c - z * d,
            w * b + x * a + y * d - z * c,
            w * c - x * d + y * a + z * b,
            w * d + x * c - y * b + z * a,
        ],
        dim=-1,
    )


def _left_matrix(quats: Tensor) -> Tensor:
    """Matrix of the product from the left, on (x, y, z, t). [N, 4] -> [N, 4, 4]"""
    w, x, y, z = quats.unbind(-1)
    rows = ((w, -z, y, x), (z, w, -x, y), (-y, x, w, z), (-x, -y, -z, w))
    return torch.stack([torch.stack(row, dim=-1) for row in rows], dim=-2)
