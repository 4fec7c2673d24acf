"""Geometry of a period as flat arrays for compiled code."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from chronoscene.kernels.compilation import inner

Array = NDArray[np.float64]
MISS = 0xFFFFFFFF
"""Primitive id that the ray caster gives to rays that hit nothing."""


class Tables(NamedTuple):
    """Geometry of one period as flat arrays; see `chronoscene.synth.render.mesh`."""

    corners: NDArray[np.float32]
    """[T, 3, 3]"""
    normals: NDArray[np.float32]
    """[T, 3, 3]"""
    tri_patch: NDArray[np.int32]
    patches: Array
    patch_style: NDArray[np.int32]
    patch_seed: NDArray[np.int32]
    styles: Array


@inner
def hit_normals(tables, tri, u, v, dx, dy, dz):  # type: ignore[no-untyped-def]
    """Flat and smooth unit normals of a hit, both turned towards the viewer."""
    a, b, c = tables.corners[tri, 0], tables.corners[tri, 1], tables.corners[tri, 2]
    e0, e1, e2 = float(b[0] - a[0]), float(b[1] - a[1]), float(b[2] - a[2])
    f0, f1, f2 = float(c[0] - a[0]), float(c[1] - a[1]), float(c[2] - a[2])
    gx, gy, gz = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
    scale = 1.0 / max(1e-12, math.sqrt(gx * gx + gy * gy + gz * gz))
    gx, gy, gz = gx * scale, gy * scale, gz * scale
    n = tables.normals[tri]
    w = 1.0 - u - v
    sx = w * n[0, 0] + u * n[1, 0] + v * n[2, 0]
    sy = w * n[0, 1] + u * n[1, 1] + v * n[2, 1]
    sz = w * n[0, 2] + u * n[1, 2] + v * n[2, 2]
    scale = 1.0 / max(1e-12, math.sqrt(sx * sx + sy * sy + sz * sz))
    sx, sy, sz = sx * scale, sy * scale, sz * scale
    if gx * dx + gy * dy + gz * dz > 0.0:
        gx, gy, gz = -gx, -gy, -gz
    return gx, gy, gz, sx, sy, sz
