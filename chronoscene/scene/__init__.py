"""The scene in memory and what follows from it alone: geometry, splits, similarities. No torch."""

from chronoscene.scene.cameras import Camera
from chronoscene.scene.scene import (
    Frame,
    Period,
    Points,
    Scene,
    Split,
    WorldFrame,
)

__all__ = [
    "Camera",
    "Frame",
    "Period",
    "Points",
    "Scene",
    "Split",
    "WorldFrame",
]
