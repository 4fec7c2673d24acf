"""Points in the frame of a camera to its pixels and back, for every camera model of COLMAP.

Pinhole cameras are a few multiplications here; distortion is left to pycolmap, which is loaded
only for it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Camera

Array = NDArray[np.float64]


def pixels_of(camera: Camera, x: Array, y: Array, z: Array) -> tuple[Array, Array]:
    """Pixel positions of points, distortion included.

    Args:
        camera: Any model of COLMAP.
        x: To the right, in the frame of the camera. [n]
        y: Down. [n]
        z: Forward, along the optical axis. [n]

    Returns:
        Positions along x and y in pixels. What is not in front of a camera with distortion, or not
        finite, is NaN; a pinhole projects what is behind it, too. [n] each
    """
    if camera.is_pinhole:
        K = camera.K
        return x / z * K[0, 0] + K[0, 2], y / z * K[1, 1] + K[1, 2]
    from chronoscene.colmap.model import to_pycolmap

    at = np.full((len(z), 2), np.nan)
    local = np.stack([x, y, z], axis=-1)
    front = (z > 0) & np.isfinite(local).all(axis=1)
    at[front] = to_pycolmap(camera).img_from_cam(local[front])
    return at[:, 0], at[:, 1]


def plane_of(camera: Camera, xy: Array) -> Array:
    """Where pixels are on the plane one unit in front of a camera, distortion undone.

    Args:
        camera: Any model of COLMAP whose rays go forward.
        xy: In pixels. [n, 2]

    Returns:
        NaN where COLMAP finds no ray. [n, 2]
    """
    if camera.is_pinhole:
        K = camera.K
        return np.asarray((xy - K[:2, 2]) / K[[0, 1], [0, 1]])
    from chronoscene.colmap.model import to_pycolmap

    return np.asarray(to_pycolmap(camera).cam_from_img(np.ascontiguousarray(xy)))
