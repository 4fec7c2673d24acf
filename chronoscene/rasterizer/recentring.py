"""Survey coordinates are millions of metres; float32 has seven digits."""

from __future__ import annotations

import torch
from torch import Tensor


def recentred(means: Tensor, viewmats: Tensor) -> tuple[Tensor, Tensor]:
    """Move the origin to the first camera: what is then cast to float32 loses nothing that counts.

    The images are the same, and so are all gradients.

    Args:
        means: Centres in world units. [N, 3]
        viewmats: World-to-camera transforms. [C, 4, 4]

    Returns:
        means: In their own float type. [N, 3]
        viewmats: float64. [C, 4, 4]
    """
    viewmats = viewmats.detach().double()
    if len(viewmats) == 0:
        return means, viewmats
    rotation, translation = viewmats[0, :3, :3], viewmats[0, :3, 3]
    centre = -torch.linalg.solve_ex(rotation, translation).result
    # What is subtracted from the means and what is added to the cameras must be the same number.
    origin = torch.where(torch.isfinite(centre).all(), centre, 0).to(means.dtype)
    moved = viewmats.clone()
    moved[:, :3, 3] += viewmats[:, :3, :3] @ origin.double()
    return means - origin, moved
