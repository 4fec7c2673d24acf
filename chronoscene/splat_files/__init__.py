"""Gaussians in the files that other programs open: a `GaussianCloud` in, bytes out, and back.

There is one module per format, with ``encode``, ``decode`` and perhaps ``with_comments``. Centres
are in the frame of the scene; formats with a convention of their own for the axes say so in their
module.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numpy.typing import ArrayLike

from chronoscene.scene.gaussian_cloud import GaussianCloud
from chronoscene.splat_files import gltf, ply, sog, splat, spz

SUFFIXES = {"ply": ".ply", "spz": ".spz", "sog": ".sog", "splat": ".splat", "gltf": ".glb"}
"""Ends of the names of files, by format."""

_MODULES: dict[str, Any] = {"ply": ply, "spz": spz, "sog": sog, "splat": splat, "gltf": gltf}


def encode(kind: str, cloud: GaussianCloud, *, antialiased: bool, up: ArrayLike) -> bytes:
    """Make a file; what a format has no place for is left out.

    Args:
        kind: Name of the format in `SUFFIXES`.
        cloud: One Gaussian at least.
        antialiased: Whether a viewer is to draw with the filter of Mip-Splatting.
        up: Direction that is up in the scene. [3]
    """
    match kind:
        case "ply":
            return ply.encode(cloud)
        case "spz":
            return spz.encode(cloud, antialiased=antialiased)
        case "sog":
            return sog.encode(cloud, antialiased=antialiased)
        case "splat":
            return splat.encode(cloud)
        case "gltf":
            return gltf.encode(cloud, up=up)
    raise ValueError(kind)


def with_comments(kind: str, data: bytes, comments: Sequence[str]) -> bytes:
    """Put lines for people into what `encode` made, where its format has a place for them."""
    module = _MODULES[kind]
    if not hasattr(module, "with_comments"):
        return data
    commented: bytes = module.with_comments(data, comments)
    return commented


def decode(kind: str, data: bytes) -> GaussianCloud:
    """Read what `encode` made, as other programs do."""
    cloud: GaussianCloud = _MODULES[kind].decode(data)
    return cloud
