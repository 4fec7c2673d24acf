"""Other ways to rasterize, to compare ours with; written for these benchmarks alone.

Each module has ``NAME``, ``WHAT`` (one line for the table) and ``make(scene) -> function``: what
the function does is timed, and it returns the image. Modules raise `UnavailableError` with a reason
where they cannot run.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from benchmarks.rasterizer.scenes import Scene


class UnavailableError(Exception):
    """Raised with the reason if a peer cannot run here."""


def by_autograd(scene: Scene, draw: Callable[[], Tensor]) -> Callable[[bool], Tensor]:
    """Make the function of a peer in torch: it draws, and goes back to all inputs if asked to.

    Args:
        scene: The inputs.
        draw: Draws it. [1, H, W, 3]
    """

    def run(backward: bool) -> Tensor:
        scene.drop_gradients()
        with torch.set_grad_enabled(backward):
            image = draw()
            if backward:
                image.backward(scene.image_grad)
        return image[0].detach()

    return run
