"""Rays and the similarity between periods: exact cases, intervals that hold the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.registration.generated import CaseSettings, Generated, generate_case, pose_errors
from chronoscene.arrays import Ints
from chronoscene.registration.quality.misalignment import (
    Motion,
    _bread,
    _interval,
    _sandwich,
    _usual,
    measure,
    rotation_angle,
    transfer_errors,
    transfers,
)
from chronoscene.registration.quality.rays import (
    TrackRays,
    cross_matches,
    held_out_rays,
    model_rays,
    place,
    project,
    sampson_distance,
)
from chronoscene.registration.result import Registered
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3

QUIET = CaseSettings(
    points=1200, ties=400, held_out=0.5, noise=1e-9, outliers=0.0, gps_noise=None, views=10
)


@pytest.fixture(scope="module")
def exact() -> Generated:
    """Two periods whose poses and observations are those of the truth."""
    made = generate_case(QUIET)
    return replace(made, model=replace(made.model, cam_from_world=made.truth))


def moved_period(model: Registered, move: Sim3) -> Registered:
    poses = model.cam_from_world.copy()
    poses[model.periods == 1] = move.apply_to_pose(poses[model.periods == 1])
    return replace(model, cam_from_world=poses)


def small_move(seed: int) -> Sim3:
    rng = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(np.radians(rng.normal(0, 0.5, 3))).as_matrix()
    return Sim3(float(1 + rng.normal(0, 0.01)), turn, rng.normal(0, 0.5, 3))


def test_points_are_placed_where_their_rays_meet(exact: Generated) -> None:
    rays = model_rays(exact.model)
    placed = place(rays)
    assert len(placed.track) > 0.9 * len(exact.model.points)
    found, slot = placed.find(rays.track)
    residual = project(rays.where(found), placed.xyz[slot])[0]
    assert np.abs(residual).max() < 1e-6
    assert placed.error.max() < 1e-6


def test_derivative_of_the_projection(exact: Generated) -> None:
    rays = model_rays(exact.model).where(np.arange(50))
    xyz = exact.model.points[rays.track]
    jacobian = project(rays, xyz)[1]
    for axis in range(3):
        step = 1e-6 * np.eye(3)[axis]
        slope = (project(rays, xyz + step)[0] - project(rays, xyz - step)[0]) / 2e-6
        np.testing.assert_allclose(jacobian[:, :, axis], slope, rtol=1e-5, atol=1e-5)


def test_a_point_behind_the_camera_has_no_residual(exact: Generated) -> None:
    rays = model_rays(exact.model).where(np.arange(3))
    behind = camera_centre(rays.pose) - rays.pose[:, 2, :3]
    assert np.isnan(project(rays, behind)[0]).all()


def test_tracks_that_do_not_fit_their_own_images_are_dropped(exact: Generated) -> None:
    rays = model_rays(exact.model)
    track = rays.track[0]
    uv = rays.uv.copy()
    uv[np.flatnonzero(rays.track == track)[0]] += 0.1  # 40 pixels
    placed = place(replace(rays, uv=uv))
    assert track not in placed.track
    assert track in place(rays).track


def test_one_image_places_nothing(exact: Generated) -> None:
    rays = model_rays(exact.model)
    assert len(place(rays.where(rays.image == 0)).track) == 0
    assert len(place(rays.where(rays.image < 0)).track) == 0


def test_held_out_tracks_of_the_truth_transfer_exactly(exact: Generated) -> None:
    moved, *_ = transfers(held_out_rays(exact.model), exact.model.periods, 0, 1)
    assert len(moved) > 300
    assert moved.backward.any() and not moved.backward.all()
    error, expected, distance = transfer_errors(moved)
    assert error.max() < 1e-5
    assert distance.max() < 1e-5
    assert (expected >= 1).all()


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 1000))
def test_the_similarity_between_periods_is_found(exact: Generated, seed: int) -> None:
    move = small_move(seed)
    model = moved_period(exact.model, move)
    centres = camera_centre(model.cam_from_world[model.periods == 1])
    found = measure(*transfers(held_out_rays(model), model.periods, 0, 1), centres)
    assert found is not None
    np.testing.assert_allclose(found.similarity.to_matrix(), move.to_matrix(), atol=2e-3)
    assert found.rotation.value == pytest.approx(rotation_angle(move.rotation), abs=2e-3)
    assert found.similarity.scale == pytest.approx(move.scale, abs=1e-4)


def test_a_gross_error_is_found_as_well(exact: Generated) -> None:
    turn = Rotation.from_euler("z", 40, degrees=True).as_matrix()
    move = Sim3(1.3, turn, np.array([30.0, -20.0, 5.0]))
    model = moved_period(exact.model, move)
    centres = camera_centre(model.cam_from_world[model.periods == 1])
    found = measure(*transfers(held_out_rays(model), model.periods, 0, 1), centres)
    assert found is not None
    assert found.rotation.value == pytest.approx(40, abs=0.05)
    assert found.rotation.low > 39


@pytest.mark.slow
def test_intervals_hold_the_truth() -> None:
    """The upper bound must hold in nearly all cases; it is what a pass rests on."""
    hits, tries = 0, 20
    for seed in range(tries):
        made = generate_case(
            CaseSettings(seed=seed, points=1200, ties=250, held_out=0.4, noise=0.6, views=10)
        )
        model = made.model
        centres = camera_centre(model.cam_from_world[model.periods == 1])
        found = measure(*transfers(held_out_rays(model), model.periods, 0, 1), centres)
        assert found is not None
        rotation, _ = pose_errors(model.cam_from_world, made.truth, model.periods == 0)
        truth = np.median(rotation[model.periods == 1])
        hits += found.rotation.low <= truth <= found.rotation.high
    assert hits >= 18


def test_motions_about_two_points_are_one_and_join_by_their_information() -> None:
    rng = np.random.default_rng(0)
    step = rng.normal(0, 1e-5, 7)
    root = rng.normal(0, 1e-3, (7, 7))
    centres = rng.normal(0, 5, (4, 3))
    motion = Motion(step, root @ root.T, np.zeros(3), centres, np.stack([centres, centres + 1]))
    moved = motion.about(np.array([3.0, -2.0, 7.0]))
    x = rng.normal(0, 10, (5, 3))
    for one, other in ((motion, moved), (moved.about(np.zeros(3)), motion)):
        np.testing.assert_allclose(
            one.similarity(one.step).apply(x), other.similarity(other.step).apply(x), atol=1e-7
        )
    twice = motion.joined(moved)
    assert twice is not None
    np.testing.assert_allclose(twice.step, motion.step, atol=1e-12)
    np.testing.assert_allclose(twice.covariance, motion.covariance / 2, rtol=1e-5, atol=1e-12)
    assert motion.joined(replace(moved, step=moved.step + 1.0)) is None


def test_a_scale_about_cameras_shows_in_the_depth_of_points() -> None:
    centres, points = np.zeros((3, 3)), np.array([[0.0, 0, 10], [1, 0, 20], [0, 2, 30]])
    step = np.array([0, 0, 0, 0, 0, 0, 0.01])
    seen = np.stack([points, centres])
    motion = Motion(step, np.eye(7), np.zeros(3), centres, seen)
    _, moved = motion.intervals()
    assert moved.value == pytest.approx(np.expm1(0.01) * np.linalg.norm(points[1]))


def test_bounds_are_as_far_away_as_the_errors_are_large(exact: Generated) -> None:
    """A known motion, measured with noisy pixels: bounds can be too tight, and too wide."""
    turn = Rotation.from_euler("x", 1, degrees=True).as_matrix()
    move = Sim3(1.0, turn, np.array([0.5, 0.3, -0.4]))
    model = moved_period(exact.model, move)
    rays = held_out_rays(model)
    rays = rays.where(np.isin(rays.track, np.unique(rays.track)[:100]))
    centres = camera_centre(model.cam_from_world[model.periods == 1])
    shift = np.median(np.linalg.norm(move.apply(centres) - centres, axis=1))
    rng, errors = np.random.default_rng(0), []
    for _ in range(16):
        noisy = replace(rays, uv=rays.uv + rng.normal(0, 0.6 / 400, rays.uv.shape))
        found = measure(*transfers(noisy, model.periods, 0, 1), centres)
        assert found is not None
        for interval, truth in ((found.rotation, 1.0), (found.shift, shift)):
            errors.append((interval.value - truth) / (interval.high - interval.value))
    # 1 but for the draws, whose root mean square is off by 1 / sqrt(2 * 16), or 18 %.
    assert 0.5 < 1.96 * np.sqrt(np.mean(np.square(errors))) < 1.5


def observed(track: Ints, image: Ints) -> TrackRays:
    """Rays of which only the groups count."""
    return TrackRays(track, image, *(np.zeros(0),) * 3)


def test_more_images_of_a_track_and_small_residuals_do_not_narrow_a_bound() -> None:
    rng, track = np.random.default_rng(0), np.arange(300)
    residual, jacobian = 2 * rng.normal(size=(300, 2)), rng.normal(size=(300, 2, 7))
    weight = np.ones(300)
    normal = np.einsum("nki,nkj->ij", jacobian, jacobian)
    once = _sandwich(observed(track, track), residual, jacobian, weight, normal)
    repeated = (np.repeat(x, 10, axis=0) for x in (residual, jacobian, weight))
    ten_times = _sandwich(observed(np.repeat(track, 10), np.arange(3000)), *repeated, 10 * normal)
    np.testing.assert_allclose(ten_times, once)
    ratios = [
        np.mean(
            np.diag(_sandwich(observed(track, track), size * residual, jacobian, weight, normal))
            / np.diag(np.linalg.inv(normal))
        )
        for size in (1.0, 0.01)
    ]
    assert ratios == pytest.approx([4.0, 1.0], rel=0.15)


def test_what_the_points_of_an_image_share_widens_a_bound() -> None:
    """Ten images of 100 points each, with an error of each pose that is as large as the noise."""
    rng, image = np.random.default_rng(0), np.repeat(np.arange(10), 100)
    jacobian = np.repeat(rng.normal(size=(10, 2, 7)), 100, axis=0)
    jacobian += 0.3 * rng.normal(size=jacobian.shape)
    noise, weight = rng.normal(size=(1000, 2)), np.ones(1000)
    normal = np.einsum("nki,nkj->ij", jacobian, jacobian)
    rays = observed(np.arange(1000), image)
    alone, shared = (
        np.sqrt(np.mean(np.diag(_sandwich(rays, residual, jacobian, weight, normal))))
        for residual in (noise, noise + rng.normal(size=(10, 2))[image])
    )
    assert shared > 3 * alone


def test_residuals_that_weights_hold_back_pull_by_less_than_their_weight() -> None:
    """The derivative of the sum that is zero at the estimate, by differences."""
    rng = np.random.default_rng(0)
    residual, jacobian = rng.normal(size=(50, 2)), rng.normal(size=(50, 2, 7))
    variance = rng.uniform(0.5, 2, 50)

    def pull(step: np.ndarray) -> np.ndarray:
        moved = residual + jacobian @ step
        weight = 1 / (variance + (moved**2).sum(axis=1) / 4)
        return np.einsum("nki,n,nk->i", jacobian, weight, moved)

    weight = 1 / (variance + (residual**2).sum(axis=1) / 4)
    expected = [(pull(1e-5 * e) - pull(-1e-5 * e)) / 2e-5 for e in np.eye(7)]
    np.testing.assert_allclose(_bread(residual, jacobian, weight), expected, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize(("tracks", "contradict"), [(12, False), (1000, True)])
def test_few_tracks_contradict_only_by_far(tracks: int, contradict: bool) -> None:
    still = Motion(np.zeros(7), np.eye(7), *(np.zeros(3),) * 3)
    moved = replace(still, step=np.full(7, 2.5), freedom=tracks - 7)
    assert (still.joined(moved) is None) == contradict


def test_the_usual_error_is_that_without_gross_ones() -> None:
    rng = np.random.default_rng(0)
    errors = np.concatenate([rng.rayleigh(0.5, 4000), rng.uniform(2, 50, 3000)])
    assert _usual(errors, 3.0) == pytest.approx(0.5 * np.sqrt(2 * np.log(2)), rel=0.05)
    assert _usual(np.array([5.0]), 1.0) == 0.0


def test_ends_of_intervals_are_percentiles_of_motions_drawn() -> None:
    drawn, noise = (np.linspace(0, end, 401) for end in (4.0, 1.0))
    for estimate, ends in ((2.0, (1.05, 3.9)), (0.5, (0.0, 3.9)), (3.95, (3.0, 3.95))):
        found = _interval(np.array([estimate]), drawn, noise)
        assert found.value == pytest.approx(estimate)
        assert (found.low, found.high) == pytest.approx(ends)


def test_matches_in_one_spot_leave_more_open() -> None:
    spread = CaseSettings(seed=5, points=2500, ties=300, held_out=0.4)
    bounds = []
    for case in (spread, replace(spread, cluster=15.0)):
        model = generate_case(case).model
        centres = camera_centre(model.cam_from_world)
        found = measure(*transfers(held_out_rays(model), model.periods, 0, 1), centres)
        assert found is not None
        bounds.append(found.rotation.high)
    assert bounds[1] > 3 * bounds[0]


def test_too_few_tracks_give_nothing() -> None:
    model = generate_case(CaseSettings(seed=1, points=1000, ties=15)).model
    moved = transfers(held_out_rays(model), model.periods, 0, 1)
    assert measure(*moved, camera_centre(model.cam_from_world)) is None


def test_twelve_tracks_are_enough(exact: Generated) -> None:
    model = exact.model
    rays = held_out_rays(model)
    tracks = np.unique(transfers(rays, model.periods, 0, 1)[0].rays.track)
    for count in (11, 12):
        some = rays.where(np.isin(rays.track, tracks[:count]))
        found = measure(*transfers(some, model.periods, 0, 1), camera_centre(model.cam_from_world))
        assert (found is not None) == (count == 12)


def test_epipolar_errors_are_zero_for_the_truth_and_grow_with_a_turn(exact: Generated) -> None:
    rays = held_out_rays(exact.model)
    matches = cross_matches(exact.model.held_out_tracks, exact.model.periods)
    a, b = (rays.where(rows) for rows in matches[0])

    def errors(pose: np.ndarray) -> np.ndarray:
        relative = pose @ np.linalg.inv(a.pose[0])
        return sampson_distance(relative, a.uv, b.uv, a.focal, b.focal)

    assert errors(b.pose[0]).max() < 1e-5
    turned = b.pose[0].copy()
    turned[:3] = Rotation.from_euler("y", 1, degrees=True).as_matrix() @ turned[:3]
    assert np.median(errors(turned)) > 0.5


@pytest.mark.parametrize("degrees", [0.0, 1e-7, 0.1, 90.0, 179.9])
def test_angles_small_and_large(degrees: float) -> None:
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, 0.0, 0.8])).as_matrix()
    assert rotation_angle(turn) == pytest.approx(degrees, rel=1e-6, abs=1e-12)


def test_pose_errors_do_not_depend_on_the_frame(exact: Generated) -> None:
    poses = moved_period(exact.model, small_move(3)).cam_from_world
    frame = Sim3(2.5, Rotation.from_euler("xyz", [1, 2, 3]).as_matrix(), np.array([1.0, 2, 3]))
    reference = exact.model.periods == 0
    one = pose_errors(poses, exact.truth, reference)
    other = pose_errors(frame.apply_to_pose(poses), exact.truth, reference)
    np.testing.assert_allclose(one[0], other[0], atol=1e-6)
    np.testing.assert_allclose(one[1], other[1], atol=1e-6)
    assert one[0][reference].max() < 1e-6
