"""gsplat's own reference in torch, the function behind its tests.

Its projection and tile intersection are plain torch, but its compositing calls the compiled
extension, so it runs only where gsplat's CUDA extension does.
"""

from __future__ import annotations

from collections.abc import Callable

from torch import Tensor

from benchmarks.rasterizer.peers import UnavailableError, by_autograd
from benchmarks.rasterizer.scenes import Scene

NAME = "gsplat torch"
WHAT = "gsplat's pure-torch reference (_rasterization)"


def make(scene: Scene) -> Callable[[bool], Tensor]:
    """Rendering of a scene; tried once, so that what it lacks is said before anything is timed."""
    try:
        from gsplat.rendering import _rasterization
    except Exception as error:
        raise UnavailableError(f"{type(error).__name__}: {error}") from error

    arrays = (*scene.gaussians, scene.viewmats, scene.Ks, scene.width, scene.height)
    run = by_autograd(scene, lambda: _rasterization(*arrays)[0])
    try:
        run(False)
    except Exception as error:  # whatever it fails with is what the table shall say
        reason = str(error).strip().splitlines() or [""]
        raise UnavailableError(f"{type(error).__name__}: {reason[0]}") from error
    return run
