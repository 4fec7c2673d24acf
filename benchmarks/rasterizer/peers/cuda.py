"""Our CUDA backend: gsplat's kernels through its public interface."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.rasterizer.peers import UnavailableError, cpu
from benchmarks.rasterizer.scenes import Scene
from chronoscene.errors import BackendError

NAME = "cuda"
WHAT = "backend cuda (gsplat), tensors on the GPU"


def make(scene: Scene) -> Callable[[bool], Tensor]:
    """Rendering of a scene on the GPU; waits for its end."""
    if not torch.cuda.is_available():
        raise UnavailableError("torch sees no CUDA device")
    draw = cpu.make(scene.to("cuda"), backend="cuda")

    def run(backward: bool) -> Tensor:
        image = draw(backward)
        torch.cuda.synchronize()
        return image

    try:
        run(backward=False)
    except BackendError as error:
        raise UnavailableError(str(error)) from error
    return run
