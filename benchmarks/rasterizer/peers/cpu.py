"""Our CPU backend."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from benchmarks.rasterizer.peers import by_autograd
from benchmarks.rasterizer.scenes import Scene
from chronoscene.rasterizer import rasterize

NAME = "cpu"
WHAT = "backend cpu (this package)"


def make(
    scene: Scene, backend: str = "cpu", *, render_depth: bool = False
) -> Callable[[bool], Tensor]:
    """Rendering of a scene, as a method calls it: checks off, new output tensors every time.

    With depth, its gradient is the sum of those of the channels.
    """

    def draw() -> Tensor:
        drawn = rasterize(
            *scene.gaussians, scene.viewmats, scene.Ks, scene.width, scene.height,
            backend=backend, render_depth=render_depth, check_finite=False,
        )  # fmt: skip
        return drawn.image if drawn.depths is None else drawn.image + drawn.depths

    return by_autograd(scene, draw)
