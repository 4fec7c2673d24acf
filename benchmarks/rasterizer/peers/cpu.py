"""Our CPU backend."""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from benchmarks.rasterizer.peers import by_autograd
from benchmarks.rasterizer.scenes import Scene
from chronoscene.rasterizer import rasterize

NAME = "cpu"
WHAT = "backend cpu (this package)"


def make(scene: Scene, backend: str = "cpu") -> Callable[[bool], Tensor]:
    """Rendering of a scene, as a method calls it: checks off, new output tensors every time."""
    return by_autograd(
        scene,
        lambda: rasterize(
            *scene.gaussians, scene.viewmats, scene.Ks, scene.width, scene.height,
            backend=backend, check_finite=False,
        ).image,
    )  # fmt: skip


def make_with_depth(scene: Scene) -> Callable[[bool], Tensor]:
    """The same with the expected depth, whose gradient is the sum of those of the channels."""

    def draw() -> Tensor:
        drawn = rasterize(
            *scene.gaussians, scene.viewmats, scene.Ks, scene.width, scene.height,
            backend="cpu", render_depth=True, check_finite=False,
        )  # fmt: skip
        assert drawn.depths is not None
        return drawn.image + drawn.depths

    return by_autograd(scene, draw)
