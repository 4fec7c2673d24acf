"""A compiled rasterizer in the usual way: scalar, one thread, as CPU ports of 3DGS do it.

Gaussian after Gaussian in depth order, pixel after pixel in a box of three standard deviations,
``exp`` of the C library, gradients added where they belong; no vectors, no masks, no threads.
Compositing and its gradients are timed; projection and depth order are made beforehand and cost
this peer nothing.
"""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from numba import njit
from torch import Tensor

from benchmarks.rasterizer.peers.projection import project
from benchmarks.rasterizer.scenes import Scene

NAME = "scalar"
WHAT = "scalar compiled code, one thread, boxes of 3 sigma; without projection and sort"


def make(scene: Scene) -> Callable[[bool], Tensor]:
    """Rendering of a scene, with gradients of what is on the screen if asked for."""
    order, splats = _splats(scene)
    color = scene.gaussians[4].detach()[order].numpy()
    opacity = scene.gaussians[3].detach()[order].numpy()
    image_grad = scene.image_grad[0].numpy()
    shape = (scene.height, scene.width)

    def run(backward: bool) -> Tensor:
        image, light = np.zeros((*shape, 3), np.float32), np.ones(shape, np.float32)
        last = np.full(shape, len(splats), np.int32)
        _forward(splats, opacity, color, image, light, last)
        if backward:
            grads = np.zeros((len(splats), 9), np.float32)
            behind = np.zeros(shape, np.float32)
            _backward(splats, opacity, color, light, last, behind, image_grad, grads)
        return torch.from_numpy(image)

    return run


def _splats(scene: Scene) -> tuple[Tensor, np.ndarray]:
    """Front to back: x, y, conic (3), half width, half height."""
    with torch.no_grad():
        centres, variances, conics, depths = project(scene)
    rows = torch.cat([centres, conics, 3 * variances.sqrt()], dim=1)
    order = torch.argsort(depths, stable=True)
    return order, np.ascontiguousarray(rows[order].numpy())


@njit(cache=True, fastmath=True, error_model="numpy")
def _box(splats, i, height, width):
    x0 = max(math.floor(splats[i, 0] - splats[i, 5]), 0)
    x1 = min(math.floor(splats[i, 0] + splats[i, 5]) + 1, width)
    y0 = max(math.floor(splats[i, 1] - splats[i, 6]), 0)
    y1 = min(math.floor(splats[i, 1] + splats[i, 6]) + 1, height)
    return np.uint32(x0), np.uint32(max(x1, x0)), np.uint32(y0), np.uint32(max(y1, y0))


@njit(cache=True, fastmath=True, error_model="numpy")
def _alpha(splats, opacity, i, x, y):
    dx = np.float32(x) + np.float32(0.5) - splats[i, 0]
    dy = np.float32(y) + np.float32(0.5) - splats[i, 1]
    square = splats[i, 2] * dx * dx + splats[i, 4] * dy * dy
    falloff = np.float32(math.exp(np.float32(-0.5) * square - splats[i, 3] * dx * dy))
    return min(np.float32(0.999), opacity[i] * falloff), falloff, dx, dy


@njit(cache=True, fastmath=True, error_model="numpy")
def _forward(splats, opacity, color, image, light, last):
    height, width = light.shape
    for i in range(len(splats)):
        x0, x1, y0, y1 = _box(splats, i, height, width)
        for y in range(y0, y1):
            for x in range(x0, x1):
                if last[y, x] <= i:
                    continue
                alpha = _alpha(splats, opacity, i, x, y)[0]
                if alpha < np.float32(1 / 255):
                    continue
                t = light[y, x]
                after = t * (np.float32(1.0) - alpha)
                if after <= np.float32(1e-4):
                    last[y, x] = i
                    continue
                image[y, x, 0] += alpha * t * color[i, 0]
                image[y, x, 1] += alpha * t * color[i, 1]
                image[y, x, 2] += alpha * t * color[i, 2]
                light[y, x] = after


@njit(cache=True, fastmath=True, error_model="numpy")
def _backward(splats, opacity, color, light, last, behind, image_grad, grads):
    """Gradients of x, y, conic, opacity, colour."""
    height, width = light.shape
    for i in range(len(splats) - 1, -1, -1):
        x0, x1, y0, y1 = _box(splats, i, height, width)
        for y in range(y0, y1):
            for x in range(x0, x1):
                if last[y, x] <= i:
                    continue
                alpha, falloff, dx, dy = _alpha(splats, opacity, i, x, y)
                if alpha < np.float32(1 / 255):
                    continue
                t = light[y, x] / (np.float32(1.0) - alpha)
                light[y, x] = t
                gr, gg, gb = image_grad[y, x, 0], image_grad[y, x, 1], image_grad[y, x, 2]
                weight = alpha * t
                grads[i, 6] += gr * weight
                grads[i, 7] += gg * weight
                grads[i, 8] += gb * weight
                own = gr * color[i, 0] + gg * color[i, 1] + gb * color[i, 2]
                d_alpha = t * (own - behind[y, x])
                behind[y, x] += alpha * (own - behind[y, x])
                if alpha < np.float32(0.999):
                    grads[i, 5] += d_alpha * falloff
                    g = -d_alpha * alpha
                    grads[i, 0] -= g * (splats[i, 2] * dx + splats[i, 3] * dy)
                    grads[i, 1] -= g * (splats[i, 4] * dy + splats[i, 3] * dx)
                    grads[i, 2] += np.float32(0.5) * g * dx * dx
                    grads[i, 3] += g * dx * dy
                    grads[i, 4] += np.float32(0.5) * g * dy * dy
