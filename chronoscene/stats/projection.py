"""Points to pixels with any camera."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene import Camera

Array = NDArray[np.float64]


def project(camera: Camera, local: Array) -> Array:
    """Points in the frame of a camera to its pixels. [n, 3] -> [n, 2]"""
    if camera.is_pinhole:
        K = camera.K
        return np.asarray(local[:, :2] / local[:, 2:] * K[[0, 1], [0, 1]] + K[:2, 2])
    from chronoscene.colmap import to_pycolmap

    finite = np.isfinite(local).all(axis=1) & (local[:, 2] > 0)
    at = np.full((len(local), 2), np.nan)
    at[finite] = to_pycolmap(camera).img_from_cam(local[finite])
    return at
