"""From Gaussians to ellipses on the screen, `LANES` at a time: what both passes compute.

Matrices are tuples of vectors, by rows.
"""

# mypy: allow-untyped-defs
# Numba infers the types of kernels.

from __future__ import annotations

from typing import Any

from chronoscene.rasterizer.cpu import layout as lay
from chronoscene.rasterizer.cpu.kernel import inlined
from chronoscene.rasterizer.cpu.simd import absolute, maximum, minimum, sqrt


@inlined
def _to_camera(camera: Any, x: Any, y: Any, z: Any) -> Any:
    """R (x - c). The centre c of the camera has a rest that float32 cannot hold: subtracted after
    c, it leaves no more error than x itself has, however far from the origin both are."""
    x = (x - camera[lay.CENTRE]) - camera[lay.CENTRE_REST]
    y = (y - camera[lay.CENTRE + 1]) - camera[lay.CENTRE_REST + 1]
    z = (z - camera[lay.CENTRE + 2]) - camera[lay.CENTRE_REST + 2]
    return (
        camera[0] * x + (camera[1] * y + camera[2] * z),
        camera[3] * x + (camera[4] * y + camera[5] * z),
        camera[6] * x + (camera[7] * y + camera[8] * z),
    )


@inlined
def unit(w: Any, x: Any, y: Any, z: Any) -> Any:
    """Unit quaternion, one over its length, largest component; scaled lest squares underflow."""
    largest = maximum(maximum(absolute(w), absolute(x)), maximum(absolute(y), absolute(z)))
    scale = 1.0 / largest
    w, x, y, z = w * scale, x * scale, y * scale, z * scale
    inverse = 1.0 / sqrt(w * w + (x * x + (y * y + z * z)))
    return w * inverse, x * inverse, y * inverse, z * inverse, inverse * scale, largest


@inlined
def rotation(w: Any, x: Any, y: Any, z: Any) -> Any:
    """Rotation matrix of a unit quaternion, by rows."""
    return (
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    )


@inlined
def _rotated_row(camera: Any, i: int, r: Any, s: Any) -> Any:
    """Row i of (world-to-camera rotation) (Gaussian's rotation) diag(scales)."""
    a, b, c = camera[3 * i], camera[3 * i + 1], camera[3 * i + 2]
    return (
        (a * r[0] + (b * r[3] + c * r[6])) * s[0],
        (a * r[1] + (b * r[4] + c * r[7])) * s[1],
        (a * r[2] + (b * r[5] + c * r[8])) * s[2],
    )


@inlined
def dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + (a[1] * b[1] + a[2] * b[2])


@inlined
def _image_row(focal: Any, ratio: Any, m: Any, depth_row: Any) -> Any:
    """Row of J M: image axis of the three scaled axes; ``focal`` is f / z."""
    return (
        focal * (m[0] - ratio * depth_row[0]),
        focal * (m[1] - ratio * depth_row[1]),
        focal * (m[2] - ratio * depth_row[2]),
    )


@inlined
def cross(a: Any, b: Any) -> Any:
    return (
        a[1] * b[2] - a[2] * b[1],
        a[2] * b[0] - a[0] * b[2],
        a[0] * b[1] - a[1] * b[0],
    )


@inlined
def _ellipse(a: Any, b: Any, blur: Any) -> Any:
    """Shear xy/yy, variance of x given y, variance of y, of Sigma = (a, b)(a, b)^T + blur I; and
    a - shear b.

    With e = b / sqrt(yy) and n = a x e the variance of x given y is |n|^2 + blur (|a|^2 / yy + 1),
    a sum of squares, where xx - xy^2 / yy would cancel. For needles a and b are large and almost
    parallel: a - shear b would cancel too, and is e x n + blur a / yy.
    """
    yy = dot(b, b) + blur
    inverse = 1.0 / sqrt(yy)
    e = (b[0] * inverse, b[1] * inverse, b[2] * inverse)
    n = cross(a, e)
    share = blur * inverse * inverse
    d = cross(e, n)
    rest = (d[0] + share * a[0], d[1] + share * a[1], d[2] + share * a[2])
    return dot(a, e) * inverse, dot(n, n) + (share * dot(a, a) + blur), yy, rest


@inlined
def project_axes(camera: Any, position: Any, quaternion: Any, scales: Any) -> Any:
    """Everything between a Gaussian in space and its ellipse.

    Args:
        camera: `layout.CAMERA` numbers.
        position: Centre in the world.
        quaternion: Unit quaternion.
        scales: Standard deviations.

    Returns:
        z-depth; (x / z, y / z); the same held within the limits of the Jacobian; rotation;
        last row of rotation and scale in the camera's frame; rows of J times these; `_ellipse`.
    """
    px, py, pz = _to_camera(camera, position[0], position[1], position[2])
    inverse = 1.0 / pz
    tx, ty = px * inverse, py * inverse
    jx = minimum(maximum(tx, camera[lay.X_MIN]), camera[lay.X_MAX])
    jy = minimum(maximum(ty, camera[lay.Y_MIN]), camera[lay.Y_MAX])
    r = rotation(quaternion[0], quaternion[1], quaternion[2], quaternion[3])
    m0 = _rotated_row(camera, 0, r, scales)
    m1 = _rotated_row(camera, 1, r, scales)
    m2 = _rotated_row(camera, 2, r, scales)
    a = _image_row(camera[lay.FX] * inverse, jx, m0, m2)
    b = _image_row(camera[lay.FY] * inverse, jy, m1, m2)
    ellipse = _ellipse(a, b, camera[lay.BLUR])
    return pz, (tx, ty), (jx, jy), r, m2, (a, b), ellipse
