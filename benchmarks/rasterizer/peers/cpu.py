"""Our CPU backend."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.rasterizer.scenes import Scene
from chronoscene.rasterizer import rasterize

NAME = "cpu"
WHAT = "backend cpu (this package)"


def make(scene: Scene, backend: str = "cpu") -> Callable[[bool], Tensor]:
    """Rendering of a scene, as a method calls it: checks off, new output tensors every time."""

    def run(backward: bool) -> Tensor:
        scene.drop_gradients()
        with torch.set_grad_enabled(backward):
            result = rasterize(
                *scene.gaussians, scene.viewmats, scene.Ks, scene.width, scene.height,
                backend=backend, check_finite=False,
            )  # fmt: skip
            if backward:
                result.image.backward(scene.image_grad)
        return result.image[0].detach()

    return run
