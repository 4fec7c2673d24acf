"""The compiled slices: each Gaussian on its own, in float64.

Both kernels do what `slice_reference` says; the backward pass computes anew what it needs. With C
the covariance at the time, G the gradient of the loss in it, and Y = X - v tau,

    d / dX = 2 G Y, d / d tau = -(2 G Y)^T v, since C = Y Y^T and Y tau^T = 0,

and G follows in the principal axes from the gradients of the scales and of the rotation.
"""

from __future__ import annotations

import math

import numpy as np
from numba import prange

from chronoscene.kernels.compilation import inner, kernel

VARIANCES_AWAY = 2 * math.log(20)
"""Square of the distance in time, over the variance, at which a Gaussian has a weight of 0.05."""

TWIN_AXES = 2e-5
"""Relative difference of two variances below which their axes count as equally long."""

SWEEPS = 5
"""Rounds of three Jacobi rotations, at most. From random axes it takes 4."""

ORTHOGONAL = 1e-8
"""Square of the cosine of two rows below which Jacobi leaves them. Gradients of the scales are
those along the axes, so nearly round Gaussians keep theirs; `_rest_of_turn` has the rest."""

BLOCK = 256  # Rows that one task handles. Fixed, so that the result does not depend on the threads.


@inner(forceinline=True)
def _product(a, b):  # type: ignore[no-untyped-def]
    """Product of quaternions wxyz."""
    return (
        a[0] * b[0] - a[1] * b[1] - a[2] * b[2] - a[3] * b[3],
        a[0] * b[1] + a[1] * b[0] + a[2] * b[3] - a[3] * b[2],
        a[0] * b[2] - a[1] * b[3] + a[2] * b[0] + a[3] * b[1],
        a[0] * b[3] + a[1] * b[2] - a[2] * b[1] + a[3] * b[0],
    )


@inner(forceinline=True)
def _conjugate(a):  # type: ignore[no-untyped-def]
    return a[0], -a[1], -a[2], -a[3]


@inner(forceinline=True)
def _turned(q, x, y, z):  # type: ignore[no-untyped-def]
    """A vector turned by a unit quaternion."""
    _, a, b, c = _product(_product(q, (0.0, x, y, z)), _conjugate(q))
    return a, b, c


@inner(forceinline=True)
def _row(quats, n):  # type: ignore[no-untyped-def]
    w, x = np.float64(quats[n, 0]), np.float64(quats[n, 1])
    return w, x, np.float64(quats[n, 2]), np.float64(quats[n, 3])


@inner(forceinline=True)
def _unit(quats, n):  # type: ignore[no-untyped-def]
    """Unit quaternion, and the length that it had."""
    w, x, y, z = _row(quats, n)
    length = math.sqrt(max(w * w + x * x + y * y + z * z, 1e-60))
    return (w / length, x / length, y / length, z / length), length


@inner(forceinline=True)
def _exp(x):  # type: ignore[no-untyped-def]
    """Exponential in float64, as all arithmetic here."""
    return math.exp(np.float64(x))


@inner
def _open(n, dt, left, right, log_scales, log_time_scales, m, y):  # type: ignore[no-untyped-def]
    """Fill m with R S in axes that the right quaternion turns, and y with Y. [4, 4], [3, 4]

    Returns:
        Whether the Gaussian is there at the time; the variance in time; v.
    """
    (w, a, b, c) = _product(_conjugate(right), left)
    sx, sy = _exp(log_scales[n, 0]), _exp(log_scales[n, 1])
    sz, st = _exp(log_scales[n, 2]), _exp(log_time_scales[n])
    m[0, 0], m[0, 1], m[0, 2], m[0, 3] = w * sx, -c * sy, b * sz, a * st
    m[1, 0], m[1, 1], m[1, 2], m[1, 3] = c * sx, w * sy, -a * sz, b * st
    m[2, 0], m[2, 1], m[2, 2], m[2, 3] = -b * sx, a * sy, w * sz, c * st
    m[3, 0], m[3, 1], m[3, 2], m[3, 3] = -a * sx, -b * sy, -c * sz, w * st
    variance = m[3, 0] ** 2 + m[3, 1] ** 2 + m[3, 2] ** 2 + m[3, 3] ** 2
    # Comparisons with nan are false.
    alive = dt * dt < VARIANCES_AWAY * variance
    if not alive:
        return False, 1.0, (0.0, 0.0, 0.0)
    vx = (m[0, 0] * m[3, 0] + m[0, 1] * m[3, 1] + m[0, 2] * m[3, 2] + m[0, 3] * m[3, 3]) / variance
    vy = (m[1, 0] * m[3, 0] + m[1, 1] * m[3, 1] + m[1, 2] * m[3, 2] + m[1, 3] * m[3, 3]) / variance
    vz = (m[2, 0] * m[3, 0] + m[2, 1] * m[3, 1] + m[2, 2] * m[3, 2] + m[2, 3] * m[3, 3]) / variance
    for column in range(4):
        y[0, column] = m[0, column] - vx * m[3, column]
        y[1, column] = m[1, column] - vy * m[3, column]
        y[2, column] = m[2, column] - vz * m[3, column]
    return True, variance, (vx, vy, vz)


@inner(forceinline=True)
def _dot(y, i, j):  # type: ignore[no-untyped-def]
    """Dot product of two rows. [3, 4]"""
    return y[i, 0] * y[j, 0] + y[i, 1] * y[j, 1] + y[i, 2] * y[j, 2] + y[i, 3] * y[j, 3]


@inner
def _jacobi(y):  # type: ignore[no-untyped-def]
    """Make rows orthogonal by turning the axes; returns the rotation of these. [3, 4]"""
    turn = (1.0, 0.0, 0.0, 0.0)
    for _ in range(SWEEPS):
        done = True
        for k in range(3):
            i, j = (k + 1) % 3, (k + 2) % 3
            alpha, beta, gamma = _dot(y, i, i), _dot(y, j, j), _dot(y, i, j)
            if not gamma * gamma > ORTHOGONAL * alpha * beta:
                continue
            done = False
            zeta = (beta - alpha) / (2 * gamma)
            tangent = -math.copysign(1 / (abs(zeta) + math.sqrt(1 + zeta * zeta)), zeta)
            c = 1 / math.sqrt(1 + tangent * tangent)
            s = c * tangent
            for column in range(4):
                one, two = y[i, column], y[j, column]
                y[i, column], y[j, column] = c * one + s * two, c * two - s * one
            half = math.sqrt((1 + c) / 2)
            side = s / (2 * half)
            zero = 0.0
            step = (
                half,
                side if k == 0 else zero,
                side if k == 1 else zero,
                side if k == 2 else zero,
            )
            turn = _product(turn, step)
        if done:
            break
    return turn


@inner(forceinline=True)
def _reciprocal(a, b):  # type: ignore[no-untyped-def]
    """1 / (a - b), but 0 where they are equal."""
    twin = TWIN_AXES * (a + b)
    return (a - b) / ((a - b) * (a - b) + twin * twin)


@inner(forceinline=True)
def _rest_of_turn(y):  # type: ignore[no-untyped-def]
    """First-order correction of what the Jacobi rotations left to do."""
    a, b, c = _dot(y, 0, 0), _dot(y, 1, 1), _dot(y, 2, 2)
    return (
        1.0,
        0.5 * _dot(y, 1, 2) * _reciprocal(b, c),
        0.5 * _dot(y, 2, 0) * _reciprocal(c, a),
        0.5 * _dot(y, 0, 1) * _reciprocal(a, b),
    )


@kernel(parallel=True)
def slice_forward(time, cycle, order, inputs, outputs):  # type: ignore[no-untyped-def]
    """Groups of `SHAPES` to groups of `OUTPUTS`, all of them float32."""
    means, log_scales, quats, logits, sh_dc, sh_rest = inputs[:6]
    right_quats, time_means, log_time_scales, waves_dc, waves_rest = inputs[6:]
    out_means, out_scales, out_quats, out_logits, out_dc, out_rest = outputs
    count = len(means)
    for block in prange((count + BLOCK - 1) // BLOCK):
        m, y = np.empty((4, 4)), np.empty((3, 4))
        for n in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            dt = time - time_means[n]
            left, _ = _unit(quats, n)
            right, _ = _unit(right_quats, n)
            alive, variance, v = _open(n, dt, left, right, log_scales, log_time_scales, m, y)
            if not alive:
                for c in range(3):
                    out_means[n, c], out_scales[n, c] = means[n, c], 0.0
                    out_dc[n, c] = sh_dc[n, c]
                for c in range(4):
                    out_quats[n, c] = right[c]
                for k in range(sh_rest.shape[1]):
                    for c in range(3):
                        out_rest[n, k, c] = sh_rest[n, k, c]
                out_logits[n] = -np.inf
                continue
            move = _turned(right, v[0], v[1], v[2])
            turn = _jacobi(y)
            turn = _product(right, _product(turn, _rest_of_turn(y)))
            for c in range(3):
                out_means[n, c] = means[n, c] + move[c] * dt
                out_scales[n, c] = 0.5 * math.log(_dot(y, c, c))
            for c in range(4):
                out_quats[n, c] = turn[c]
            log_w, o = -0.5 * dt * dt / variance, np.float64(logits[n])
            out_logits[n] = o + log_w - math.log1p(-math.exp(o) * math.expm1(log_w))
            one = two = np.float32(0.0)
            if order > 0:
                one = np.float32(math.cos(2 * math.pi / cycle * dt))
            if order > 1:
                two = np.float32(math.cos(4 * math.pi / cycle * dt))
            for c in range(3):
                wave = one * waves_dc[n, 0, c] + two * waves_dc[n, 1, c]
                out_dc[n, c] = sh_dc[n, c] + wave
            for k in range(sh_rest.shape[1]):
                for c in range(3):
                    wave = one * waves_rest[n, 0, k, c] + two * waves_rest[n, 1, k, c]
                    out_rest[n, k, c] = sh_rest[n, k, c] + wave


@inner
def _is_zero(g_means, g_scales, g_quats, g_logits, g_dc, g_rest, n):  # type: ignore[no-untyped-def]
    """Return True if no output of a Gaussian has a gradient."""
    found = g_logits[n] != 0
    for c in range(3):
        found |= (g_means[n, c] != 0) | (g_scales[n, c] != 0) | (g_dc[n, c] != 0)
    for c in range(4):
        found |= g_quats[n, c] != 0
    for k in range(g_rest.shape[1]):
        for c in range(3):
            found |= g_rest[n, k, c] != 0
    return not found


@inner(forceinline=True)
def _column(d, m, i):  # type: ignore[no-untyped-def]
    """Product of two columns. [4, 4]"""
    return d[0, i] * m[0, i] + d[1, i] * m[1, i] + d[2, i] * m[2, i] + d[3, i] * m[3, i]


@inner(forceinline=True)
def _store_gradient(grad, unit, length, out, n):  # type: ignore[no-untyped-def]
    """Gradient of a quaternion from that of its unit quaternion."""
    along = grad[0] * unit[0] + grad[1] * unit[1] + grad[2] * unit[2] + grad[3] * unit[3]
    for c in range(4):
        out[n, c] = (grad[c] - along * unit[c]) / length


@kernel(parallel=True)
def slice_backward(time, cycle, order, inputs, grads, found):  # type: ignore[no-untyped-def]
    """Gradients of the parameters, d, from those of the outputs, g.

    Inputs are without means, sh_dc and sh_rest, whose gradients are those of the outputs.
    ``found`` holds zeros.
    """
    log_scales, quats, logits, right_quats, time_means, log_time_scales = inputs[:6]
    waves_dc, waves_rest = inputs[6:]
    g_means, g_scales, g_quats, g_logits, g_dc, g_rest = grads
    d_scales, d_quats, d_logits, d_right_quats, d_time_means, d_log_time_scales = found[:6]
    d_waves_dc, d_waves_rest = found[6:]
    count = len(quats)
    for block in prange((count + BLOCK - 1) // BLOCK):
        m, y, d = np.empty((4, 4)), np.empty((3, 4)), np.empty((4, 4))
        for n in range(block * BLOCK, min(count, (block + 1) * BLOCK)):
            dt = time - time_means[n]
            left, left_length = _unit(quats, n)
            right, right_length = _unit(right_quats, n)
            if _is_zero(g_means, g_scales, g_quats, g_logits, g_dc, g_rest, n):  # in no view
                continue
            alive, variance, v = _open(n, dt, left, right, log_scales, log_time_scales, m, y)
            if not alive:
                continue
            turn = _jacobi(y)
            back = _conjugate(turn)

            # In the principal axes: 2 G Y, its diagonal from the scales, the rest from the turn.
            g_turn = _product(_conjugate(right), _row(g_quats, n))
            _, gx, gy, gz = _product(back, g_turn)
            a, b, c = _dot(y, 0, 0), _dot(y, 1, 1), _dot(y, 2, 2)
            ga, gb, gc = g_scales[n, 0] / a, g_scales[n, 1] / b, g_scales[n, 2] / c
            gx *= 0.5 * _reciprocal(b, c)
            gy *= 0.5 * _reciprocal(c, a)
            gz *= 0.5 * _reciprocal(a, b)
            # Of v, in the axes of the right quaternion, and what the rows of Y make of it.
            g_move = _turned(
                _conjugate(right),
                np.float64(g_means[n, 0]),
                np.float64(g_means[n, 1]),
                np.float64(g_means[n, 2]),
            )
            wx, wy, wz = g_move[0] * dt, g_move[1] * dt, g_move[2] * dt
            px, py, pz = _turned(back, wx, wy, wz)
            along = v[0] * wx + v[1] * wy + v[2] * wz
            # Of the logarithm of w, and of o.
            log_w, e = -0.5 * dt * dt / variance, _exp(logits[n])
            g_o = g_logits[n] / (1 - e * math.expm1(log_w))
            g_log_w = g_o * (1 + e)
            d_logits[n] = g_o
            for i in range(4):
                row = y[0, i], y[1, i], y[2, i]
                sx, sy, sz = _turned(
                    turn,
                    ga * row[0] + gz * row[1] + gy * row[2],
                    gb * row[1] + gz * row[0] + gx * row[2],
                    gc * row[2] + gy * row[0] + gx * row[1],
                )
                tau = m[3, i] / variance
                d[0, i], d[1, i], d[2, i] = sx + wx * tau, sy + wy * tau, sz + wz * tau
                d[3, i] = (px * row[0] + py * row[1] + pz * row[2]) / variance - along * tau
                d[3, i] += g_log_w * dt * dt / variance * tau
                d[3, i] -= sx * v[0] + sy * v[1] + sz * v[2]
            for i in range(3):
                d_scales[n, i] = _column(d, m, i)
            d_log_time_scales[n] = _column(d, m, 3)

            s0, s1 = _exp(log_scales[n, 0]), _exp(log_scales[n, 1])
            s2, s3 = _exp(log_scales[n, 2]), _exp(log_time_scales[n])
            g_pair = (
                d[0, 0] * s0 + d[1, 1] * s1 + d[2, 2] * s2 + d[3, 3] * s3,
                d[2, 1] * s1 - d[1, 2] * s2 + d[0, 3] * s3 - d[3, 0] * s0,
                d[0, 2] * s2 - d[2, 0] * s0 + d[1, 3] * s3 - d[3, 1] * s1,
                d[1, 0] * s0 - d[0, 1] * s1 + d[2, 3] * s3 - d[3, 2] * s2,
            )
            _store_gradient(_product(right, g_pair), left, left_length, d_quats, n)
            one = _product(left, _conjugate(g_pair))
            two = _product(turn, _rest_of_turn(y))
            two = _product(_row(g_quats, n), _conjugate(two))
            swing = (0.0, v[1] * wz - v[2] * wy, v[2] * wx - v[0] * wz, v[0] * wy - v[1] * wx)
            three = _product(right, swing)
            g_right = (
                one[0] + two[0] + 2 * three[0],
                one[1] + two[1] + 2 * three[1],
                one[2] + two[2] + 2 * three[2],
                one[3] + two[3] + 2 * three[3],
            )
            _store_gradient(g_right, right, right_length, d_right_quats, n)

            g_dt = v[0] * g_move[0] + v[1] * g_move[1] + v[2] * g_move[2] - g_log_w * dt / variance
            for k in range(order):
                speed = 2 * math.pi * (k + 1) / cycle
                wave, total = np.float32(math.cos(speed * dt)), np.float32(0.0)
                for c3 in range(3):
                    d_waves_dc[n, k, c3] = wave * g_dc[n, c3]
                    total += waves_dc[n, k, c3] * g_dc[n, c3]
                for i in range(g_rest.shape[1]):
                    for c3 in range(3):
                        d_waves_rest[n, k, i, c3] = wave * g_rest[n, i, c3]
                        total += waves_rest[n, k, i, c3] * g_rest[n, i, c3]
                g_dt -= speed * math.sin(speed * dt) * total
            d_time_means[n] = -g_dt
