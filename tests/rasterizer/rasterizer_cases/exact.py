"""The image at a few pixels with 60 digits, straight from the equations of the README."""

from __future__ import annotations

from typing import Any

import mpmath  # type: ignore[import-untyped]
import numpy as np
from mpmath import mp, mpf

from .scenes import SmallScene

DIGITS = 60

# Numbers of gsplat's classic mode. Written out, not imported: who changes a constant of the
# rasterizer is told so here.
ALPHA_MIN = mpf(1) / 255
ALPHA_MAX = float(np.float32(0.999))
TRANSMITTANCE_MIN = mpf("1e-4")
CLAMP_MARGIN = mpf("0.3")
EPS2D = 0.3
NEAR_PLANE = 0.01


def exact_pixels(scene: SmallScene, pixels: list[tuple[int, int]]) -> np.ndarray:
    """Colours and opacity of pixels (column, row) of the first camera. [P, D + 1]"""
    with mp.workdps(DIGITS):
        splats = [_project(scene, i) for i in range(len(scene.means))]
        near = mpf(dict(scene.options).get("near_plane", NEAR_PLANE))
        drawn = [s for s in splats if s is not None and s["depth"] >= near]
        drawn.sort(key=lambda s: s["depth"])
        return np.array([_composite(scene, drawn, *pixel) for pixel in pixels], np.float64)


def _matrix(array: np.ndarray) -> Any:
    return mpmath.matrix(array.astype(np.float64).tolist())


def _rotation(quaternion: np.ndarray) -> Any:
    q = [mpf(float(x)) for x in quaternion]
    w, x, y, z = (c / mpmath.sqrt(sum(c * c for c in q)) for c in q)
    return mpmath.matrix(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _project(scene: SmallScene, i: int) -> dict[str, Any] | None:
    """Depth, centre and inverse covariance on the screen; None for what has no rotation."""
    if not np.any(scene.quats[i]):
        return None
    viewmat, K = _matrix(scene.viewmats[0]), _matrix(scene.Ks[0])
    rotation = viewmat[:3, :3]
    p = rotation * _matrix(scene.means[i]) + viewmat[:3, 3]
    if p[2] == 0:
        return None
    axes = rotation * _rotation(scene.quats[i]) * mpmath.diag([float(s) for s in scene.scales[i]])
    jacobian, centre = mpmath.zeros(2, 3), []
    for k, size in enumerate((scene.width, scene.height)):
        f, c, ratio = K[k, k], K[k, 2], p[k] / p[2]
        margin = CLAMP_MARGIN * size / (2 * f)
        jacobian[k, k] = f / p[2]
        jacobian[k, 2] = -f / p[2] * min(max(ratio, -c / f - margin), (size - c) / f + margin)
        centre.append(f * ratio + c)
    blur = mpf(dict(scene.options).get("eps2d", EPS2D))
    seen = jacobian * axes
    sharp, opacity = seen * seen.T, mpf(float(scene.opacities[i]))
    # Written out, as is the quadratic form below: matrices of mpmath take ten times as long.
    xx, xy, yy = sharp[0, 0] + blur, sharp[0, 1], sharp[1, 1] + blur
    determinant = xx * yy - xy * xy
    if dict(scene.options).get("antialiased"):
        opacity *= mpmath.sqrt(mpmath.det(sharp) / determinant)
    conic = (yy / determinant, -xy / determinant, xx / determinant)
    found = {"i": i, "depth": p[2], "centre": centre, "conic": conic}
    return found | {"opacity": opacity}


def _composite(
    scene: SmallScene, splats: list[dict[str, Any]], column: int, row: int
) -> list[float]:
    light, values = mpf(1), [mpf(0)] * scene.colors.shape[1]
    for s in splats:
        dx, dy = column + mpf(0.5) - s["centre"][0], row + mpf(0.5) - s["centre"][1]
        xx, xy, yy = s["conic"]
        power = xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy
        alpha = s["opacity"] * mpmath.exp(-power / 2)
        if alpha < ALPHA_MIN:
            continue
        alpha = min(alpha, mpf(ALPHA_MAX))
        if light * (1 - alpha) <= TRANSMITTANCE_MIN:
            break
        color = scene.colors[s["i"]]
        values = [v + alpha * light * float(c) for v, c in zip(values, color, strict=True)]
        light *= 1 - alpha
    if scene.backgrounds is not None:
        background = scene.backgrounds[0]
        values = [v + light * float(b) for v, b in zip(values, background, strict=True)]
    return [float(v) for v in [*values, 1 - light]]
