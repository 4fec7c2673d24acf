"""A renderer of Gaussians without the antialiasing filter, as most viewers are: float64, NumPy.

It shares no code with chronoscene/rasterizer/. Constants are those of the viewer of 3DGS: a blur of
0.3 square pixels, alpha at most 0.99 and at least 1/255, and no more light below 1/10,000.

Source: Kerbl et al. 2023, "3D Gaussian Splatting for Real-Time Radiance Field Rendering".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from chronoscene.scene.gaussian_cloud import GaussianCloud

Array = NDArray[np.float64]

BLUR, LARGEST_ALPHA, SMALLEST_ALPHA, LEAST_LIGHT = 0.3, 0.99, 1 / 255, 1e-4


def render(
    cloud: GaussianCloud,
    K: Array,
    cam_from_world: Array,
    size: tuple[int, int],
    *,
    background: Array,
    near_plane: float = 0.01,
) -> Array:
    """Draw Gaussians in a pinhole camera.

    Args:
        cloud: In the world frame.
        K: Intrinsics in pixels. [3, 3]
        cam_from_world: Pose. [4, 4]
        size: Width and height in pixels.
        background: Colour behind everything. [3]
        near_plane: Nearest depth that is drawn.

    Returns:
        image: [H, W, 3]
    """
    rotation, translation = cam_from_world[:3, :3], cam_from_world[:3, 3]
    points = cloud.means.astype(np.float64) @ rotation.T + translation
    colours = _colours(cloud, -rotation.T @ translation)
    image = np.zeros((size[1], size[0], 3))
    light = np.ones((size[1], size[0]))
    in_front = np.flatnonzero(points[:, 2] >= near_plane)
    for n in in_front[np.argsort(points[in_front, 2], kind="stable")]:
        axes = rotation @ _axes(cloud.quats[n].astype(np.float64), cloud.scales[n])
        covariance = _on_screen(points[n], axes, K, size)
        centre = (K @ points[n])[:2] / points[n, 2]
        _draw(image, light, centre, covariance, float(cloud.opacities[n]), colours[n])
    return image + light[..., None] * background


def _axes(quat: Array, scales: Array) -> Array:
    """Return the columns of R diag(s). [3, 3]"""
    w, x, y, z = quat / np.sqrt(quat @ quat)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return (np.eye(3) + 2 * w * cross + 2 * cross @ cross) * scales


def _on_screen(point: Array, axes: Array, K: Array, size: tuple[int, int]) -> Array:
    """Return the covariance in square pixels, with the blur. [2, 2]"""
    x, y, z = point
    fx, fy = K[0, 0], K[1, 1]
    # The slope of the projection is taken at most 15 % of the image outside of it.
    low, high = -0.15 * np.array(size) - K[:2, 2], 1.15 * np.array(size) - K[:2, 2]
    u, v = np.clip([x / z, y / z], low / [fx, fy], high / [fx, fy])
    jacobian = np.array([[fx / z, 0, -fx * u / z], [0, fy / z, -fy * v / z]])
    half = jacobian @ axes
    return half @ half.T + BLUR * np.eye(2)


def _draw(
    image: Array, light: Array, centre: Array, covariance: Array, opacity: float, colour: Array
) -> None:
    """Add one Gaussian, in place."""
    if opacity < SMALLEST_ALPHA:
        return
    reach = np.sqrt(2 * np.log(opacity / SMALLEST_ALPHA) * np.diag(covariance))
    height, width = light.shape
    left, top = np.maximum(np.floor(centre - reach), 0).astype(int)
    right, bottom = np.minimum(np.ceil(centre + reach) + 1, [width, height]).astype(int)
    if left >= right or top >= bottom:
        return
    dx = np.arange(left, right) + 0.5 - centre[0]
    dy = (np.arange(top, bottom) + 0.5 - centre[1])[:, None]
    a, b, c = np.linalg.inv(covariance)[[0, 0, 1], [0, 1, 1]]
    alpha = opacity * np.exp(-0.5 * (a * dx * dx + 2 * b * dx * dy + c * dy * dy))
    alpha = np.minimum(alpha, LARGEST_ALPHA)
    left_over = light[top:bottom, left:right]
    alpha[(alpha < SMALLEST_ALPHA) | (left_over < LEAST_LIGHT)] = 0
    image[top:bottom, left:right] += (left_over * alpha)[..., None] * colour
    left_over *= 1 - alpha


def _colours(cloud: GaussianCloud, eye: Array) -> Array:
    """Evaluate the spherical harmonics of degree 0 to 3 in the order of 3DGS. [N, 3]"""
    offsets = cloud.means - eye
    x, y, z = (offsets / np.linalg.norm(offsets, axis=1, keepdims=True)).T
    basis = [
        *(np.full_like(x, 0.28209479177387814), -0.4886025119029199 * y),
        *(0.4886025119029199 * z, -0.4886025119029199 * x),
        *(1.0925484305920792 * x * y, -1.0925484305920792 * y * z),
        0.31539156525252005 * (3 * z * z - 1),
        *(-1.0925484305920792 * x * z, 0.5462742152960396 * (x * x - y * y)),
        -0.5900435899266435 * y * (3 * x * x - y * y),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (5 * z * z - 1),
        0.3731763325901154 * z * (5 * z * z - 3),
        -0.4570457994644658 * x * (5 * z * z - 1),
        1.445305721320277 * z * (x * x - y * y),
        -0.5900435899266435 * x * (x * x - 3 * y * y),
    ]
    return np.maximum(np.einsum("kn,nkc->nc", np.array(basis), cloud.sh_coeffs) + 0.5, 0)
