"""Models against GPS: robust similarity, lines of cameras, the horizon."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from chronoscene.colmap.model import read_reconstruction
from chronoscene.registration.reconstruct.gps_alignment import (
    Priors,
    align_to_gps,
    to_gps_frame,
    upright_direction,
)
from chronoscene.scene.geometry import camera_centre, look_at
from chronoscene.scene.similarity import Sim3

Array = NDArray[np.float64]

WORLD_FROM_MODEL = Sim3(0.4, np.eye(3)[[2, 0, 1]], np.array([-7.0, 2.0, 9.0]))


def circle(count: int, radius: float = 20.0) -> Array:
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    return np.stack(
        [
            look_at(np.array([radius * np.cos(a), radius * np.sin(a), 8.0]), np.zeros(3))
            for a in angles
        ]
    )


def test_gps_with_gross_outliers() -> None:
    rng = np.random.default_rng(6)
    world = circle(30)
    model = WORLD_FROM_MODEL.inverse().apply_to_pose(world)
    enu = camera_centre(world) + rng.normal(0, 0.3, (30, 3))
    wrong = [3, 11, 25]
    enu[wrong] += rng.uniform(50, 300, (3, 3))
    enu[7] = np.nan
    found = align_to_gps(model, enu)
    assert found is not None
    assert found.is_useful
    assert not found.inliers[[*wrong, 7]].any()
    assert found.inliers.sum() >= 24
    np.testing.assert_allclose(
        found.enu_from_model.apply(camera_centre(model)), camera_centre(world), atol=0.5
    )
    assert np.isnan(found.residuals[7])
    assert found.rms == pytest.approx(0.3 * np.sqrt(3), rel=0.3)


def test_positions_beyond_four_median_residuals_do_not_count() -> None:
    rng = np.random.default_rng(6)
    world = circle(30)
    enu = camera_centre(world) + rng.normal(0, 0.3, (30, 3))
    enu[[3, 11]] += [0.0, 0.0, 3.0]  # six times the median
    found = align_to_gps(world, enu)
    assert found is not None
    assert found.inliers.tolist() == [i not in (3, 11) for i in range(30)]


def test_gps_noise_as_large_as_the_scene_is_of_no_use() -> None:
    rng = np.random.default_rng(7)
    world = circle(12, radius=2.0)
    enu = camera_centre(world) + rng.normal(0, 3.0, (12, 3))
    found = align_to_gps(world, enu)
    assert found is not None
    assert not found.is_useful


def test_a_straight_walk_stands_upright_by_its_horizon() -> None:
    rng = np.random.default_rng(8)
    world = np.stack(
        [
            look_at(np.array([2.0 * i, 0.0, 1.6]), np.array([2.0 * i + 5, rng.normal(0, 2), 1.6]))
            for i in range(20)
        ]
    )
    model = WORLD_FROM_MODEL.inverse().apply_to_pose(world)
    enu = camera_centre(world) + rng.normal(0, 0.2, (20, 3))
    found = align_to_gps(model, enu)
    assert found is not None
    assert found.on_a_line
    aligned = found.enu_from_model.apply_to_pose(model)
    assert upright_direction(aligned)[2] > 0.999


def test_fewer_than_three_positions_say_nothing() -> None:
    world = circle(5)
    enu = np.full((5, 3), np.nan)
    enu[:2] = camera_centre(world)[:2]
    assert align_to_gps(world, enu) is None


def test_up_of_photos_that_look_straight_down() -> None:
    rng = np.random.default_rng(9)
    poses = np.stack(
        [
            look_at(
                np.array([*rng.uniform(-9, 9, 2), 50.0]),
                np.array([0.0, 0.0, 0.0]),
                roll=rng.uniform(-np.pi, np.pi),
            )
            for _ in range(10)
        ]
    )
    assert upright_direction(poses)[2] > 0.9


def test_up_is_not_down_when_the_world_is_turned_over() -> None:
    turned = np.diag([1.0, -1.0, -1.0])
    poses = circle(12)
    assert upright_direction(poses)[2] > 0.999
    poses[:, :3, :3] = poses[:, :3, :3] @ turned
    assert upright_direction(poses)[2] < -0.999


def test_priors_are_as_uncertain_along_each_axis_as_their_residuals(
    make_scene_folder: Callable[..., Path],
) -> None:
    model, centres = as_model(make_scene_folder)
    noise = np.random.default_rng(10).normal(0, 0.5, (40, 3))
    enu = {n: (c + e).tolist() for (n, c), e in zip(centres.items(), noise, strict=True)}
    moved, priors = to_gps_frame(model, Priors(enu, dict.fromkeys(enu, [0.01] * 3)), [])
    assert moved and len(priors.sigma) > 35
    np.testing.assert_allclose(list(priors.sigma.values()), 0.5, rtol=0.25)


def flight(rng: np.random.Generator) -> Array:
    """Forty photos straight down, in strips there and back, by a gimbal that is not exact."""
    poses = []
    for strip in range(5):
        for i in range(8):
            x = 15.0 * (i if strip % 2 == 0 else 7 - i)
            place = np.array([x, 25.0 * strip, 50.0])
            target = np.array([*(place[:2] + rng.normal(0, 1, 2)), 0.0])
            roll = np.pi * (strip % 2) + rng.normal(0, 0.05)
            poses.append(look_at(place, target, roll=roll))
    return np.stack(poses)


def test_heights_that_scatter_over_70_m_do_not_tilt_the_ground() -> None:
    rng = np.random.default_rng(11)
    world = flight(rng)
    enu = camera_centre(world) + rng.normal(0, [0.5, 0.5, 0.0], (40, 3))
    enu[:, 2] += rng.uniform(-35, 35, 40)
    found = align_to_gps(WORLD_FROM_MODEL.inverse().apply_to_pose(world), enu)
    assert found is not None and found.by_horizon
    error = found.enu_from_model @ WORLD_FROM_MODEL.inverse()
    assert np.degrees(np.arccos(error.rotation[2, 2])) < 2.0
    assert error.scale == pytest.approx(1.0, abs=0.01)


def test_precise_heights_level_the_model_whatever_its_photos_look_at() -> None:
    rng = np.random.default_rng(12)
    world = flight(rng)
    world[:, :3, :3] = Sim3(1, _turn(8.0), np.zeros(3)).rotation @ world[:, :3, :3]
    enu = camera_centre(world) + rng.normal(0, [0.5, 0.5, 1.0], (40, 3))
    found = align_to_gps(world, enu)
    assert found is not None and not found.by_horizon
    assert np.degrees(np.arccos(found.enu_from_model.rotation[2, 2])) < 0.5


def _turn(degrees: float) -> Array:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[1, 0, 0], [0, c, -s], [0, s, c]])


def as_model(make_scene_folder: Callable[..., Path]) -> tuple[Any, dict[str, Array]]:
    """A model of 40 images, and their centres a hundred times as large."""
    names = [f"{i:02d}.png" for i in range(40)]
    folder = make_scene_folder(dict.fromkeys(names, 0), tests=[])
    model = read_reconstruction(folder / "sparse" / "0")
    return model, {
        str(i.name): 100 * np.asarray(i.projection_center()) for i in model.images.values()
    }


def test_positions_with_rtk_count_before_the_others(make_scene_folder: Callable[..., Path]) -> None:
    model, centres = as_model(make_scene_folder)
    rng = np.random.default_rng(13)
    names = sorted(centres)
    fixed = set(names[::2])
    enu = {n: (centres[n] + rng.normal(0, 0.02 if n in fixed else 20.0, 3)).tolist() for n in names}
    sigma = {n: [0.02, 0.02, 0.03] if n in fixed else [5.0, 5.0, 10.0] for n in names}
    moved, used = to_gps_frame(model, Priors(enu, sigma), [])
    assert moved and set(used.enu) <= fixed and len(used.enu) > 15
    for image in model.images.values():
        np.testing.assert_allclose(image.projection_center(), centres[str(image.name)], atol=0.1)


def test_a_scale_known_to_nine_percent_is_no_metre(make_scene_folder: Callable[..., Path]) -> None:
    model, centres = as_model(make_scene_folder)
    rng = np.random.default_rng(14)
    spread = float(np.sqrt(np.stack(list(centres.values())).var(axis=0).sum()))
    noise = 0.088 * spread * np.sqrt(40)
    enu = {n: (c + rng.normal(0, noise, 3)).tolist() for n, c in centres.items()}
    remarks: list[str] = []
    moved, _ = to_gps_frame(model, Priors(enu, dict.fromkeys(enu, [5.0] * 3)), remarks)
    assert not moved
    assert any("not accurate enough for metres" in r for r in remarks)


@pytest.mark.parametrize(
    "height_noise",
    [1.0, pytest.param(30.0, marks=pytest.mark.slow)],  # the latter leaves heights out
)
def test_the_stated_error_of_the_scale_is_that_of_repeated_flights(height_noise: float) -> None:
    rng = np.random.default_rng(15)
    world = flight(rng)
    scales, stated = [], []
    for _ in range(60):
        noise = rng.normal(0, [1.0, 1.0, height_noise], (40, 3))
        found = align_to_gps(world, camera_centre(world) + noise)
        assert found is not None and found.by_horizon is (height_noise > 1)
        scales.append(found.enu_from_model.scale)
        stated.append(found.scale_error)
    assert np.median(stated) == pytest.approx(np.std(scales), rel=0.25)
