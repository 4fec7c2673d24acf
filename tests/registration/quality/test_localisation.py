"""Images localised from points of another period: what noise explains of the differences."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from chronoscene.arrays import Array
from chronoscene.registration.quality.localisation import Localisation, localise
from chronoscene.registration.quality.rays import PlacedPoints, TrackRays
from chronoscene.scene.geometry import pose_from_rotation_translation

IMAGES, FOCAL = 50, 800.0

POSE = pose_from_rotation_translation(
    Rotation.from_euler("xyz", [10, -20, 5], degrees=True).as_matrix(), np.array([1.0, -2.0, 30.0])
)


def observed(
    points: int, noise: Array, point_noise: float = 0.0, images: int = IMAGES
) -> tuple[TrackRays, PlacedPoints]:
    """Images at one pose, each with points of its own.

    Args:
        points: Number that each image sees.
        noise: Of the observations, pixels. [images * points, 2]
        point_noise: Standard deviation of the placed points.
        images: Number.
    """
    rng = np.random.default_rng(1)
    count = images * points
    xyz = rng.uniform([-10, -8, -6], [10, 8, 6], (count, 3))
    local = xyz @ POSE[:3, :3].T + POSE[:3, 3]
    rays = TrackRays(
        track=np.arange(count),
        image=np.repeat(np.arange(images), points),
        pose=np.broadcast_to(POSE, (count, 4, 4)),
        uv=local[:, :2] / local[:, 2:] + noise / FOCAL,
        focal=np.full((count, 2), FOCAL),
    )
    placed = PlacedPoints(
        track=np.arange(count),
        xyz=xyz + rng.normal(0, 1, (count, 3)) * point_noise,
        covariance=np.broadcast_to(point_noise**2 * np.eye(3), (count, 3, 3)),
        error=np.ones(count),
    )
    return rays, placed


def found(rays: TrackRays, placed: PlacedPoints) -> Localisation:
    result = localise(rays, placed)
    assert isinstance(result, Localisation)
    assert result.images == result.tried
    return result


def test_an_image_is_localised_by_twelve_points() -> None:
    rays, placed = observed(12, np.zeros((12, 2)), images=1)
    assert found(rays, placed).images == 1
    assert localise(rays.where(np.arange(11)), placed) == (
        "no image sees 12 points that the other period places"
    )


@pytest.mark.parametrize(
    ("points", "heavy_tails", "point_noise"),
    [(30, False, 0.0), (700, False, 0.0), (100, True, 0.0), (100, False, 0.05)],
)
def test_noise_explains_differences_that_it_causes_and_no_others(
    points: int, heavy_tails: bool, point_noise: float
) -> None:
    rng = np.random.default_rng(0)
    shape = IMAGES * points, 2
    noise = rng.standard_t(2.5, shape) / 2 if heavy_tails else rng.normal(0, 1, shape)
    rays, placed = observed(points, noise, point_noise)
    by_noise = found(rays, placed)
    assert by_noise.rotation > 0
    # The median of squares lies below their mean, so that nothing is left of noise alone.
    assert by_noise.rotation_excess.value == 0
    assert by_noise.centre_excess.value == 0

    turned = POSE.copy()
    turned[:3] = Rotation.from_euler("y", 1, degrees=True).as_matrix() @ turned[:3]
    wrong = found(replace(rays, pose=np.broadcast_to(turned, rays.pose.shape)), placed)
    assert wrong.rotation_excess.value == pytest.approx(1, abs=0.05)
    assert wrong.rotation_excess.low > 0.9
