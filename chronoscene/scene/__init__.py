"""The scene in memory and what follows from it alone: geometry, splits, similarities. No torch."""

from chronoscene.scene.scene import (
    PINHOLE_MODELS,
    POLYNOMIAL_MODELS,
    Camera,
    Frame,
    Period,
    Points,
    Scene,
    Split,
    WorldFrame,
    select_tracks,
)

__all__ = [
    "PINHOLE_MODELS",
    "POLYNOMIAL_MODELS",
    "Camera",
    "Frame",
    "Period",
    "Points",
    "Scene",
    "Split",
    "WorldFrame",
    "select_tracks",
]
