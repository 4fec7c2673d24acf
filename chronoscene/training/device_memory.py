"""Estimate of the memory that a training of Gaussians takes on a GPU.

Counted are what grows with the model and with the photo. Not counted are what CUDA itself takes,
networks, and what PyTorch's allocator keeps in reserve. Two numbers are assumptions: that a view
sees all of the model, and `TILES`.
"""

from __future__ import annotations

FLOAT = 4
STATE = 3
"""Numbers that training keeps for each trained one: its gradient and two moments."""
SPLAT = 14
"""Numbers of a Gaussian as it is drawn (`chronoscene.training.drawing.Splats`); it has as many
gradients."""
PROJECTED = 12
"""Numbers of a projected Gaussian: centre 2, conic 3, depth 1, radii 2, opacity 1, colour 3."""
PROJECTED_GRADIENTS = 9
"""Numbers of these that have a gradient: centre, conic, opacity and colour."""
TILES = 4
"""Tiles of 16 x 16 pixels that a Gaussian touches, on average."""
TILE_ENTRY = 24
"""Bytes for a Gaussian in a tile: a key of 8 and a number of 4, twice, as they are sorted."""
PIXEL = 250
"""Bytes for a pixel of the photo, the images made of it, and their gradients, as measured on a CPU
(`chronoscene.harness.plan.memory`)."""


def device_memory(primitives: int, numbers: int, drawn: int, pixels: int) -> dict[str, int]:
    """Return the bytes of each part.

    Args:
        primitives: Anchors or Gaussians.
        numbers: Trained numbers of each.
        drawn: Gaussians that each becomes.
        pixels: Of the largest photo.
    """
    model, gaussians = primitives * numbers * FLOAT, primitives * drawn
    tiles = TILES * TILE_ENTRY
    return {
        "model": model,
        "gradients and moments": STATE * model,
        "drawn Gaussians": gaussians * 2 * SPLAT * FLOAT,
        "rasterizer": gaussians * ((PROJECTED + PROJECTED_GRADIENTS) * FLOAT + tiles),
        "images": pixels * PIXEL,
    }
