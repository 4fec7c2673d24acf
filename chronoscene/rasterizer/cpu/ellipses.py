"""From Gaussians to ellipses on the screen, `LANES` at a time: what both passes compute.

Matrices are tuples of vectors, by rows.
"""

from __future__ import annotations

from typing import Any

from chronoscene.kernels.compilation import inlined
from chronoscene.kernels.vectors import absolute, as_float, as_int, maximum, minimum, select, sqrt
from chronoscene.rasterizer.cpu import layout


@inlined
def _to_camera(camera: Any, x: Any, y: Any, z: Any) -> Any:
    """R (x - c). The centre c of the camera has a rest that float32 cannot hold: subtracted after
    c, it leaves no more error than x itself has, however far from the origin both are."""
    x = (x - camera[layout.CENTRE]) - camera[layout.CENTRE_REST]
    y = (y - camera[layout.CENTRE + 1]) - camera[layout.CENTRE_REST + 1]
    z = (z - camera[layout.CENTRE + 2]) - camera[layout.CENTRE_REST + 2]
    return (
        camera[0] * x + (camera[1] * y + camera[2] * z),
        camera[3] * x + (camera[4] * y + camera[5] * z),
        camera[6] * x + (camera[7] * y + camera[8] * z),
    )


@inlined
def scaled(w: Any, x: Any, y: Any, z: Any) -> Any:
    """Quaternion times a power of two, which rounds nothing and keeps squares within float32; its
    squared length; the power; the largest component before."""
    largest = maximum(maximum(absolute(w), absolute(x)), maximum(absolute(y), absolute(z)))
    power = as_float(0x7F800000 - (as_int(largest) & 0x7F800000))  # the largest becomes 2 to 4
    w, x, y, z = w * power, x * power, y * power, z * power
    return (w, x, y, z), w * w + (x * x + (y * y + z * z)), power, largest


@inlined
def rotation(w: Any, x: Any, y: Any, z: Any) -> Any:
    """Rotation matrix of a quaternion times its squared length, by rows.

    Not that of the unit quaternion: its rounding would move axes that are almost at right angles to
    a row, and 1 - 2 (y^2 + z^2) would cancel there.
    """
    p, m = (w - z) * (w + z), (x - y) * (x + y)
    return (
        p + m,
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        p - m,
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        (w - x) * (w + x) + (z - y) * (z + y),
    )


@inlined
def _rotated_row(a: Any, b: Any, c: Any, r: Any) -> Any:
    """(a, b, c) times the matrix r."""
    return (
        a * r[0] + (b * r[3] + c * r[6]),
        a * r[1] + (b * r[4] + c * r[7]),
        a * r[2] + (b * r[5] + c * r[8]),
    )


@inlined
def dot(a: Any, b: Any) -> Any:
    return a[0] * b[0] + (a[1] * b[1] + a[2] * b[2])


@inlined
def times(a: Any, b: Any) -> Any:
    return a[0] * b[0], a[1] * b[1], a[2] * b[2]


@inlined
def by(k: Any, a: Any) -> Any:
    return k * a[0], k * a[1], k * a[2]


@inlined
def plus(a: Any, b: Any) -> Any:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2]


@inlined
def either(mask: Any, a: Any, b: Any) -> Any:
    return select(mask, a[0], b[0]), select(mask, a[1], b[1]), select(mask, a[2], b[2])


@inlined
def cross(a: Any, b: Any) -> Any:
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@inlined
def _image_row(focal: Any, ratio: Any, m: Any, depth_row: Any) -> Any:
    """Motion along an image axis for a step along each Gaussian axis, as long as the depth."""
    return (
        focal * (m[0] - ratio * depth_row[0]),
        focal * (m[1] - ratio * depth_row[1]),
        focal * (m[2] - ratio * depth_row[2]),
    )


@inlined
def project_axes(camera: Any, position: Any, r: Any) -> Any:
    """Project the centre and the axes of a Gaussian onto the screen.

    Args:
        camera: `layout.CAMERA` numbers.
        position: Centre in the world.
        r: Rotation times any factor, by rows.

    Returns:
        z-depth, one over it, (x / z, y / z), the same held within the limits of the Jacobian; the
        last row of the rotation in the camera's frame; rows A, B of depth times J times the
        rotation; their cross product over that factor, which is f_x f_y times the line of sight as
        the Gaussian sees it: of A and B, almost parallel far beside the image, it would cancel.
    """
    px, py, pz = _to_camera(camera, position[0], position[1], position[2])
    inverse = 1.0 / pz
    # The Jacobian of the projection is J = ((f_x, 0, -f_x jx), (0, f_y, -f_y jy)) / z, with jx and
    # jy the ratios x / z and y / z held near the image.
    tx, ty = px * inverse, py * inverse
    jx = minimum(maximum(tx, camera[layout.X_MIN]), camera[layout.X_MAX])
    jy = minimum(maximum(ty, camera[layout.Y_MIN]), camera[layout.Y_MAX])
    m2 = _rotated_row(camera[6], camera[7], camera[8], r)
    rows = (
        _image_row(camera[layout.FX], jx, _rotated_row(camera[0], camera[1], camera[2], r), m2),
        _image_row(camera[layout.FY], jy, _rotated_row(camera[3], camera[4], camera[5], r), m2),
    )
    c = layout.COFACTORS
    sight = _rotated_row(
        jx * camera[c] + (jy * camera[c + 3] + camera[c + 6]),
        jx * camera[c + 1] + (jy * camera[c + 4] + camera[c + 7]),
        jx * camera[c + 2] + (jy * camera[c + 5] + camera[c + 8]),
        r,
    )
    normal = by(camera[layout.FX] * camera[layout.FY], sight)
    return (pz, inverse, (tx, ty), (jx, jy)), m2, rows, normal


@inlined
def ellipse(rows: Any, normal: Any, s: Any, t: Any, blur: Any, sideways: Any) -> Any:
    """Sigma = (a, b)(a, b)^T + blur I with a, b = A s, B s, as a variance and a conditional one.

    b is that of the two whose variance is the larger, so that the shear is at most one: else where
    a long flat ellipse is cut by the image, what a pixel's offset has along it would be a small
    difference.

    With e = b / sqrt(bb) and n = a x e the variance of a given b is |n|^2 + blur (|a|^2 / bb + 1),
    a sum of squares, where aa - ab^2 / bb would cancel. For needles a and b are large and almost
    parallel: a - shear b would cancel too, and is e x n + blur a / bb. Each axis is taken out of
    that, so that it can be as thin as it likes.

    Args:
        rows, normal: From `project_axes`.
        s, t: Standard deviations over depth; s over the factor in the rotation, too.
        blur: Variance that is added.
        sideways: Whether b is the row of x, not that of y.

    Returns:
        b and B; shear ab/bb; variance of a given b, that of b and one over its square root;
        (a - shear b) / s; a and n, of which |n|^2 over the variance of a given b is the ratio of
        the determinants of Sigma without the blur and with it.
    """
    first, second = either(sideways, rows[1], rows[0]), either(sideways, rows[0], rows[1])
    a, b = times(first, s), times(second, s)
    bb = dot(b, b) + blur
    inverse = 1.0 / sqrt(bb)
    e = by(inverse, b)
    normal = by(select(sideways, 0.0 - inverse, inverse), normal)
    # a x b by the line of sight; the rest a - shear b = e x n + blur a / bb.
    n = (s[1] * t[2] * normal[0], s[2] * t[0] * normal[1], s[0] * t[1] * normal[2])
    share = blur * inverse * inverse
    rest = plus(cross(times(e, t), normal), by(share, first))
    given = dot(n, n) + (share * dot(a, a) + blur)
    return b, second, dot(a, e) * inverse, given, (bb, inverse), rest, (a, n)
