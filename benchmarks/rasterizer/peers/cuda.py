"""Our CUDA backend: gsplat's kernels through its public interface."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.rasterizer.peers import UnavailableError
from benchmarks.rasterizer.scenes import Scene
from chronoscene.errors import BackendError
from chronoscene.rasterizer import rasterize

NAME = "cuda"
WHAT = "backend cuda (gsplat), tensors on the GPU"


def make(scene: Scene) -> Callable[[bool], Tensor]:
    """Rendering of a scene on the GPU; waits for its end."""
    if not torch.cuda.is_available():
        raise UnavailableError("torch sees no CUDA device")
    there = scene.to("cuda")

    def run(backward: bool) -> Tensor:
        there.drop_gradients()
        with torch.set_grad_enabled(backward):
            result = rasterize(
                *there.gaussians, there.viewmats, there.Ks, there.width, there.height,
                backend="cuda", check_finite=False,
            )  # fmt: skip
            if backward:
                result.image.backward(there.image_grad)
        torch.cuda.synchronize()
        return result.image[0].detach()

    try:
        run(backward=False)
    except BackendError as error:
        raise UnavailableError(str(error)) from error
    return run
