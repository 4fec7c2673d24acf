"""Named settings: what differs from the defaults of `ChronoGSConfig`, which are the paper's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

_SHORT: dict[str, Any] = {
    "voxel_size": 0.5,
    "voxel_unit": "spacing",
    "max_initial_anchors": 100_000,
    "max_anchors": 200_000,
}
"""For thousands of steps instead of tens of thousands. The voxel follows the sparse cloud, so the
unit of the scene does not matter."""

PRESETS: Mapping[str, Mapping[str, Any]] = {
    "paper": {},
    "fast": _SHORT | {"iterations": 800, "density_interval": 40, "offsets_per_anchor": 5},
    "balanced": _SHORT | {"iterations": 3_000, "density_interval": 50},
    "accurate": _SHORT | {"iterations": 8_000, "density_interval": 50},
}
