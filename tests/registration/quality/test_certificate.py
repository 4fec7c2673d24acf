"""Certificate and verdict on generated registrations: no wrong one passes."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from benchmarks.registration.generated import CaseSettings, generate_case, pose_errors
from chronoscene.registration.quality import certificate as certificate_module
from chronoscene.registration.quality.certificate import Certificate, HeldOut, certify, scene_extent
from chronoscene.registration.quality.gps_fit import (
    NEIGHBOURS,
    PeriodGpsFit,
    displaced_parts,
    fit_gps,
)
from chronoscene.registration.quality.localisation import Localisation
from chronoscene.registration.quality.misalignment import Misalignment, Motion, Transfers
from chronoscene.registration.quality.overlap import ground_plan, tie_spread
from chronoscene.registration.quality.position import POSITION_THRESHOLDS, Position
from chronoscene.registration.quality.rays import PlacedPoints, gather
from chronoscene.registration.quality.surface_distance import SurfaceDistance, surface_distance
from chronoscene.registration.quality.thresholds import THRESHOLDS
from chronoscene.registration.quality.verdict import judge
from chronoscene.registration.report.certificate_json import (
    Figure,
    pair_figures,
    period_figures,
    to_json,
)
from chronoscene.registration.result import HeldOutTracks, Registered
from chronoscene.scene import Camera
from chronoscene.scene.geometry import camera_centre
from chronoscene.scene.similarity import Sim3

PLACED = Position("doubtful", "By GPS.", (), check=None, control=None, gps=None, ground_pixel=None)

GOOD = CaseSettings(ties=800, seed=21, held_out=0.3)


@pytest.fixture(scope="module")
def good() -> Registered:
    return generate_case(GOOD).model


@pytest.fixture(scope="module")
def certificate(good: Registered) -> Certificate:
    return certify(good)


@pytest.fixture(scope="module")
def small() -> Registered:
    """For what does not depend on GPS, nor on the number of points."""
    return generate_case(replace(GOOD, points=800, ties=250, gps_noise=None)).model


def without_held_out(model: Registered) -> Registered:
    return replace(model, held_out_tracks=HeldOutTracks.empty())


def test_a_good_registration_passes(certificate: Certificate) -> None:
    verdict = judge(certificate)
    assert verdict.level == "pass", verdict.objections
    assert "took no part" in verdict.text
    assert verdict.pairs == {(0, 1): "pass"}


def test_every_figure_is_measured(certificate: Certificate) -> None:
    (pair,) = certificate.pairs
    assert isinstance(pair.held_out, HeldOut)
    assert isinstance(pair.misalignment, Misalignment)
    assert isinstance(pair.by_all, Misalignment)
    assert isinstance(pair.localised_a, Localisation)
    assert isinstance(pair.localised_b, Localisation)
    assert isinstance(pair.surfaces, SurfaceDistance)
    assert all(isinstance(p.gps, PeriodGpsFit) for p in certificate.periods)
    assert pair.held_out.median < 1.0
    assert pair.held_out.distance < 0.4
    assert pair.surfaces.median < pair.surfaces.level
    assert pair.localised_b.images == 14


def test_equal_models_give_equal_certificates(good: Registered, certificate: Certificate) -> None:
    again = certify(good)
    assert json.dumps(to_json(again, judge(again), PLACED)) == json.dumps(
        to_json(certificate, judge(certificate), PLACED)
    )


def test_the_frame_does_not_matter(good: Registered, certificate: Certificate) -> None:
    """Without a georeference, the same model in another frame and scale has the same figures."""
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", [0.3, 1.0, -2.0]).as_matrix()
    move = Sim3(0.01, turn, np.array([5.0, -3.0, 2.0]))
    moved = replace(
        good,
        cam_from_world=move.apply_to_pose(good.cam_from_world),
        points=move.apply(good.points),
        georeference=None,
    )
    (a,), (b,) = certificate.pairs, certify(moved).pairs
    assert isinstance(a.by_all, Misalignment) and isinstance(b.by_all, Misalignment)
    assert isinstance(a.held_out, HeldOut) and isinstance(b.held_out, HeldOut)
    assert b.by_all.rotation.value == pytest.approx(a.by_all.rotation.value, rel=0.02)
    # The drawn numbers of the interval belong to other axes: equal up to chance.
    assert b.by_all.rotation.high == pytest.approx(a.by_all.rotation.high, rel=0.3)
    assert b.by_all.shift.value == pytest.approx(0.01 * a.by_all.shift.value, rel=0.02)
    assert b.held_out.median == pytest.approx(a.held_out.median, rel=1e-3)


CASES: dict[str, dict[str, Any]] = {
    "rotation": {"rotation": 0.5},
    "shift": {"shift": 1.5},
    "scale": {"scale": 0.02},
    "turned over": {"rotation": 160.0, "shift": 50.0},
    "one step of a repetition": {"repeated": 1.0, "step": 6.0},
    "repetition in one spot": {"repeated": 1.0, "step": 3.0, "cluster": 20.0},
    "by GPS": {"by_gps": True},
    "by GPS, few matches": {"by_gps": True, "ties": 20},
    "nothing in common": {"by_gps": True, "ties": 0},
    "few matches in one spot": {"ties": 25, "cluster": 8.0},
    "drift": {"doming": 2.5},
    "four periods, the last wrong": {"periods": 4, "rotation": 0.4},
}


ALIKE = (
    "turned over",
    "by GPS, few matches",
    "few matches in one spot",
    "one step of a repetition",
    "four periods, the last wrong",
)
"""Cases that others resemble."""


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=pytest.mark.slow) if n in ALIKE else n for n in CASES]
)
def test_no_wrong_registration_passes(name: str) -> None:
    settings = CaseSettings(**({"ties": 400, "seed": 31, "points": 1500} | CASES[name]))
    made = generate_case(settings)
    model = made.model
    rotation, centre = pose_errors(model.cam_from_world, made.truth, model.periods == 0)
    last = model.periods == model.num_periods - 1
    wrong = np.median(rotation[last]) > 0.1
    wrong |= 100 * np.median(centre[last]) / scene_extent(model) > 0.2
    verdict = judge(certify(model))
    assert wrong, "the case must be a wrong one"
    assert verdict.level != "pass"
    assert verdict.objections and verdict.todo


def test_gross_errors_fail() -> None:
    for change in ({"rotation": 1.0}, {"shift": 4.0}, {"by_gps": True}):
        made = generate_case(CaseSettings(ties=400, points=1000, seed=32, **change))  # type: ignore[arg-type]
        assert judge(certify(made.model)).level == "fail"


@pytest.mark.parametrize(
    ("longer", "wider", "gap"), [(1.0, 0, 0.0), (1.009, 0, 0.896), (1.06, 0, None), (1.0, 2, None)]
)
def test_focal_lengths_of_one_lens_are_compared(
    small: Registered, longer: float, wider: int, gap: float | None
) -> None:
    def second(camera: Camera) -> Camera:
        fx, fy, *rest = camera.params
        params = (fx * longer, fy * longer, *rest)
        return replace(camera, params=params, width=camera.width + wider)

    cameras = tuple(
        second(c) if p == 1 else c for c, p in zip(small.cameras, small.periods, strict=True)
    )
    found = certify(replace(small, cameras=cameras)).pairs[0].focal_gap
    assert found == (gap if gap is None else pytest.approx(gap, abs=1e-3))


def test_nothing_in_common_is_a_fail_that_says_so() -> None:
    verdict = judge(certify(generate_case(CaseSettings(ties=0, by_gps=True, seed=33)).model))
    assert verdict.level == "fail"
    assert "no measurement links" in verdict.text
    assert verdict.pairs == {(0, 1): None}


@pytest.mark.slow
def test_a_chain_of_good_pairs_is_good() -> None:
    """Periods 0 and 3 share nothing, but each is linked to the next."""
    settings = CaseSettings(
        periods=4, chain=True, ties=700, held_out=0.4, points=4000, noise=0.3, seed=34
    )
    made = generate_case(settings)
    certificate = certify(made.model)
    assert sum(p.ties.points == 0 for p in certificate.pairs) == 3
    verdict = judge(certificate)
    assert verdict.level == "pass", verdict.objections
    assert verdict.pairs[0, 3] is None


def test_without_held_out_tracks_there_is_no_pass(good: Registered) -> None:
    certificate = certify(without_held_out(good))
    verdict = judge(certificate)
    assert verdict.level == "doubtful"
    assert any(f.check == "held_out" for f in verdict.objections)
    (pair,) = certificate.pairs
    assert isinstance(pair.held_out, str)
    texts = [f.text for f in pair_figures(certificate, pair)]
    assert any(t.startswith("absent: no held-out track") for t in texts)


def test_missing_photos_are_counted_with_their_reasons(good: Registered) -> None:
    lost = {f"t1/lost{i}.jpg": "too few matches" for i in range(40)}
    model = replace(good, unregistered=lost, unregistered_periods=dict.fromkeys(lost, 1))
    certificate = certify(model)
    assert certificate.periods[1].photos == 54
    assert certificate.periods[1].reasons == {"too few matches": 40}
    verdict = judge(certificate)
    assert verdict.level == "doubtful"
    assert verdict.objections[0].check == "registered"


def test_points_that_three_images_see_are_counted(
    good: Registered, certificate: Certificate
) -> None:
    """Images of any date count; points of two images are left where the rest of a track is cut."""
    first, lengths = good.track_start[:-1], np.diff(good.track_start)
    place = np.arange(len(good.track_image)) - np.repeat(first, lengths)
    kept = place < np.where(np.arange(len(lengths)) % 4, 2, 3).repeat(lengths)
    start = np.concatenate([[0], np.cumsum(np.add.reduceat(kept, first))])
    cut = replace(
        good, track_start=start, track_image=good.track_image[kept], track_xy=good.track_xy[kept]
    )
    three = np.diff(start) >= 3
    for p, figures in enumerate(certify(cut).periods):
        sees = np.logical_or.reduceat(good.periods[cut.track_image] == p, start[:-1])
        assert figures.in_three == pytest.approx(three[sees].mean())
        assert 0.1 < figures.in_three < 0.3
    assert all(f.in_three is not None and f.in_three > 0.8 for f in certificate.periods)


def test_a_period_without_any_image(small: Registered) -> None:
    model = replace(small, num_periods=3, labels=("a", "b", "c"), dates=(None, None, None))
    certificate = certify(model)
    verdict = judge(certificate)
    assert verdict.level == "fail"
    assert any(f.place == "period c" and f.check == "images" for f in verdict.objections)
    json.dumps(to_json(certificate, verdict, PLACED), allow_nan=False)


def test_one_image(good: Registered) -> None:
    model = replace(
        without_held_out(good),
        names=good.names[:1],
        periods=good.periods[:1],
        cam_from_world=good.cam_from_world[:1],
        cameras=good.cameras[:1],
        points=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        track_start=np.zeros(1, np.int64),
        track_image=np.zeros(0, np.int64),
        track_xy=np.zeros((0, 2)),
        gps_enu=good.gps_enu[:1],
        gps_used=good.gps_used[:1],
    )
    certificate = certify(model)
    assert judge(certificate).level == "fail"
    json.dumps(to_json(certificate, judge(certificate), PLACED), allow_nan=False)


def test_json_has_units_numbers_and_reasons(certificate: Certificate) -> None:
    data = json.loads(json.dumps(to_json(certificate, judge(certificate), PLACED), allow_nan=False))
    assert data["alignment"]["verdict"] == "pass"
    assert data["absolute_position"]["verdict"] == "doubtful"
    assert data["unit"] == "metre"
    figures = {f["name"]: f for f in data["pairs"][0]["figures"]}
    assert figures["rotation by held-out tracks"]["unit"] == "degrees"
    assert len(figures["rotation by held-out tracks"]["interval"]) == 2
    assert "tracks" in figures["rotation by held-out tracks"]["over"]
    for pair in data["pairs"]:
        for figure in pair["figures"]:
            assert (figure["value"] is None) == bool(figure["absent"]), figure
    assert len(data["thresholds"]) == len(THRESHOLDS)
    assert len(list(period_figures(certificate.periods[0]))) >= 6


def test_scales_are_shown_as_far_as_they_differ_from_1() -> None:
    scale = Figure("scale against own GPS", 1.000312, "", "", interval=(0.99871, 1.00192))
    assert scale.text == "1.00031 (0.99871 to 1.0019)"
    size = Figure("level of detection, median", 0.123456, "m", "", interval=(0.10441, 0.15))
    assert size.text == "0.123 m (0.1 to 0.15)"


@pytest.mark.parametrize("key", THRESHOLDS)
def test_thresholds_are_in_order_and_explained(key: str) -> None:
    threshold = THRESHOLDS[key]
    better = -1 if threshold.larger_is_better else 1
    assert threshold.level(threshold.doubtful) == "pass"
    assert threshold.level(threshold.doubtful + better * 1e-9) != "pass"
    if threshold.fail is not None:
        assert better * threshold.fail >= better * threshold.doubtful
        assert threshold.level(threshold.fail + better * 1e-9) == "fail"
    assert threshold.why and threshold.todo


def test_tie_spread_tells_a_cluster_from_a_spread() -> None:
    values = []
    for cluster in (None, 12.0):
        model = generate_case(CaseSettings(seed=41, ties=300, points=1500, cluster=cluster)).model
        cells = ground_plan(model.points)
        values.append(tie_spread(model, gather(model).seen, 0, 1, cells))
    assert values[0].occupied > 0.5 > 0.15 > values[1].occupied
    assert values[0].hull > 0.7 > 0.2 > values[1].hull
    assert len(values[1].gaps) == 20


@pytest.mark.parametrize(
    ("error", "expected", "agreeing"),
    [(2.99, 1.0, 1.0), (3.01, 1.0, 0.0), (2.99, 0.5, 1.0), (5.99, 2.0, 1.0), (6.01, 2.0, 0.0)],
)
def test_an_observation_agrees_within_three_pixels_or_three_deviations(
    small: Registered,
    monkeypatch: pytest.MonkeyPatch,
    error: float,
    expected: float,
    agreeing: float,
) -> None:
    monkeypatch.setattr(certificate_module, "transfer_errors", constant(error, expected))
    held_out = certify(small).pairs[0].held_out
    assert isinstance(held_out, HeldOut)
    assert held_out.agreeing == agreeing
    assert held_out.noise == pytest.approx(error / expected)


def test_points_that_are_placed_badly_are_not_measured(
    small: Registered, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A transfer that is uncertain by more than four pixels is no measurement."""
    monkeypatch.setattr(certificate_module, "transfer_errors", constant(1.0, 3.99))
    assert isinstance(certify(small).pairs[0].held_out, HeldOut)
    monkeypatch.setattr(certificate_module, "transfer_errors", constant(1.0, 4.01))
    assert isinstance(certify(small).pairs[0].held_out, str)


def constant(error: float, expected: float) -> Callable[[Transfers], tuple[np.ndarray, ...]]:
    """All observations with one error and one expected deviation, pixels."""
    return lambda moved: tuple(np.full(len(moved), x) for x in (error, expected, 0.1))


def test_limits_of_the_overlap_and_of_tied_images(good: Registered) -> None:
    """Three points of each period make a cell common; eight ties make an image tied."""
    # Cells 0 and 1 have three points of either period, cell 2 has two of the second.
    cell = np.array([0] * 3 + [1] * 6 + [2] * 5)
    of_a = np.array([1] * 3 + [1, 1, 1, 0, 0, 0] + [1, 1, 1, 0, 0], bool)
    of_b = np.array([1] * 3 + [0, 0, 0, 1, 1, 1] + [0, 0, 0, 1, 1], bool)
    points = np.random.default_rng(0).uniform(0, 1, (len(cell), 3))
    model = replace(good, points=points, **tracks_of(points, [range(8), range(7)]))
    images = np.array([0, 1])
    model = replace(model, names=good.names[:2], periods=images)
    found = tie_spread(model, np.stack([of_a, of_b], 1), 0, 1, (points[:, :2], cell))
    assert (found.points, found.cells, found.occupied) == (3, 2, 0.5)
    every = np.ones((len(cell), 2), bool)
    found = tie_spread(model, every, 0, 1, (points[:, :2], cell))
    assert (found.tied_a, found.tied_b) == (1.0, 0.0)


def tracks_of(points: np.ndarray, seen: Sequence[range]) -> dict[str, np.ndarray]:
    """Tracks where each image sees some of the points."""
    pairs = sorted((p, i) for i, mine in enumerate(seen) for p in mine)
    point, image = np.array(pairs).T
    return {
        "track_start": np.searchsorted(point, np.arange(len(points) + 1)),
        "track_image": image,
        "track_xy": np.zeros((len(pairs), 2)),
    }


def plane(rng: np.random.Generator, count: int, noise: float) -> np.ndarray:
    """Ground and two walls, so that all directions are seen."""
    uv = rng.uniform(-10, 10, (count, 2))
    ground = np.column_stack([uv, np.zeros(count)])
    wall = np.column_stack([uv[:, 0], np.full(count, 10.0), uv[:, 1] + 10])
    other = np.column_stack([np.full(count, 10.0), uv[:, 0], uv[:, 1] + 10])
    return np.concatenate([ground, wall, other]) + rng.normal(0, noise, (3 * count, 3))


def as_cloud(xyz: np.ndarray) -> PlacedPoints:
    count = len(xyz)
    return PlacedPoints(np.arange(count), xyz, np.tile(np.eye(3), (count, 1, 1)), np.zeros(count))


@pytest.mark.parametrize("shift", [(0.0, 0.0, 0.0), (0.3, 0.0, 0.0), (0.1, -0.2, 0.25)])
def test_clouds_find_a_shift_without_matches(shift: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    first, second = plane(rng, 2000, 0.02), plane(rng, 2000, 0.02) + shift
    second[:600] += [0.0, 0.0, 3.0]  # a part that has changed
    found = surface_distance(as_cloud(first), as_cloud(second), np.zeros(3) + 5.0, 0.0)
    assert isinstance(found, SurfaceDistance)
    assert found.shift.low <= np.linalg.norm(shift) <= found.shift.high
    assert found.shift.value == pytest.approx(np.linalg.norm(shift), abs=0.03)
    if any(shift):
        assert found.shift.low > 0.2
        assert found.beyond > 0.4
    else:
        assert found.beyond < 0.1


def test_the_level_of_detection_has_the_error_of_registration_at_its_confidence() -> None:
    rng = np.random.default_rng(0)
    clouds = as_cloud(plane(rng, 2000, 0.02)), as_cloud(plane(rng, 2000, 0.02))
    levels = []
    for registration in (0.0, 0.5):
        found = surface_distance(*clouds, np.zeros(3) + 5.0, registration)
        assert isinstance(found, SurfaceDistance)
        levels.append(found.level)
    assert levels[1] - levels[0] == pytest.approx(1.96 * 0.5)


def boxes(rng: np.random.Generator, noise: float) -> np.ndarray:
    """Walls of 20 boxes on flat ground, with a dozen points each."""
    middle = np.random.default_rng(7).uniform(-50, 50, (20, 2))
    parts = [np.column_stack([rng.uniform(-60, 60, (900, 2)), np.zeros(900)])]
    for axis in (0, 1):
        for side in (-4.0, 4.0):
            wall = np.add(rng.uniform(-4, 4, (20, 12, 3)), [0.0, 0.0, 4.0])
            wall[:, :, axis] = side
            wall[:, :, :2] += middle[:, None]
            parts.append(wall.reshape(-1, 3))
    every = np.concatenate(parts)
    return every + rng.normal(0, noise, every.shape)


def test_small_patches_measure_a_turn_that_wide_ones_leave_open(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Sixteen points that are near each other do not lie on one wall here; six often do."""
    turn = Rotation.from_euler("z", 0.3, degrees=True)
    still = Motion.none(np.zeros((1, 3)), np.full((1, 3), 40.0), np.full((1, 3), 40.0))

    def turns() -> tuple[float, float]:
        """Root mean square error of the turn, and its standard deviation, degrees."""
        errors, deviations = [], []
        for seed in range(5):
            rng = np.random.default_rng(seed)
            first, second = boxes(rng, 0.05), turn.apply(boxes(rng, 0.05))
            found = surface_distance(
                as_cloud(first), as_cloud(second), np.array([0.0, 0.0, 99.0]), 0.0, still
            )
            assert isinstance(found, SurfaceDistance) and found.motion is not None
            errors.append(np.degrees(found.motion.step[5]) - 0.3)
            deviations.append(np.degrees(np.sqrt(found.motion.covariance[5, 5])))
        return float(np.sqrt(np.mean(np.square(errors)))), float(np.mean(deviations))

    fine = turns()
    monkeypatch.setattr("chronoscene.registration.quality.surface_distance.FINER", ())
    wide = turns()
    assert fine[0] < 0.1
    assert fine[0] < 1.5 * fine[1]
    assert fine[1] < wide[1] / 2


def test_clouds_too_small_or_apart_say_so() -> None:
    rng = np.random.default_rng(0)
    cloud = as_cloud(plane(rng, 200, 0.01))
    few = surface_distance(as_cloud(cloud.xyz[:5]), cloud, np.zeros(3), 0.0)
    apart = surface_distance(cloud, as_cloud(cloud.xyz + 500), np.zeros(3), 0.0)
    assert isinstance(few, str) and "too few" in few
    assert isinstance(apart, str) and "have a surface at" in apart


def test_gps_finds_offset_scale_and_turn() -> None:
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(1)
    centres = rng.uniform(-80, 80, (40, 3)) * [1, 1, 0.2]
    turn = Rotation.from_euler("z", 5, degrees=True)
    gps = 1.1 * turn.apply(centres) + [4.0, -3.0, 20.0] + rng.normal(0, 1.0, centres.shape)
    gps[:4] += 200
    gps[5] = np.nan
    found = fit_gps(centres, gps)
    assert isinstance(found, PeriodGpsFit)
    assert found.positions == 39
    assert found.outliers == 4
    assert found.scale == pytest.approx(1.1, abs=0.03)
    assert found.turn == pytest.approx(5.0, abs=1.5)
    assert found.largest > 150 > 3 > found.median
    assert fit_gps(centres[6:9], gps[6:9]) == "fewer than 4 images have a GPS position"
    assert isinstance(fit_gps(centres[6:10], gps[6:10]), PeriodGpsFit)
    assert isinstance(fit_gps(centres, np.full_like(centres, np.nan)), str)


@pytest.mark.parametrize("count", [100, 1600])
def test_an_offset_of_gps_is_known_as_well_as_its_median(count: int) -> None:
    rng = np.random.default_rng(1)
    centres = rng.uniform(-80, 80, (count, 3))
    offset = np.array([4.0, -3.0, 20.0])
    found = fit_gps(centres, centres + offset + rng.normal(0, 2.0, centres.shape))
    assert isinstance(found, PeriodGpsFit)
    expected = 2.0 * np.sqrt(np.pi / 2 / count)
    np.testing.assert_allclose(found.offset_error, expected, rtol=0.25)
    assert np.abs(found.offset - offset).max() < 3 * expected


def test_extent_of_cameras_that_stand_still(good: Registered) -> None:
    poses = good.cam_from_world.copy()
    poses[:, :3, 3] = -np.einsum("nij,j->ni", poses[:, :3, :3], [1.0, 2.0, 3.0])
    still = replace(good, cam_from_world=poses)
    assert np.ptp(camera_centre(poses), axis=0).max() < 1e-9
    assert 5 < scene_extent(still) < 30


@pytest.mark.slow
def test_a_forward_facing_capture_is_measured_by_its_depth() -> None:
    """Right ones pass although cameras stand close together, wrong ones fail."""
    case = CaseSettings(arc=20.0, ties=600, points=2000, views=16, seed=5, gps_noise=None)
    certificate = certify(generate_case(case).model)
    assert 80 < certificate.extent < 130
    assert judge(certificate).level == "pass"
    for wrong in (replace(case, scale=0.01), replace(case, rotation=0.3), replace(case, shift=0.6)):
        assert judge(certify(generate_case(wrong).model)).level == "fail"


def test_the_documented_thresholds_are_those_of_the_code() -> None:
    text = (Path(__file__).parents[3] / "docs/reference/certificate.md").read_text(encoding="utf-8")
    for t in (*THRESHOLDS.values(), *POSITION_THRESHOLDS.values()):
        sign = "below" if t.larger_is_better else "above"
        unit = f" {t.unit}" if t.unit else ""
        fail = f"{sign} {t.fail:g}{unit}" if t.fail is not None else "-"
        assert f"| {t.what} | {sign} {t.doubtful:g}{unit} | {fail} | {t.why} |" in text


def test_a_period_far_from_its_own_gps_is_doubtful(good: Registered) -> None:
    """Half of a period stands elsewhere: its GPS is the witness."""
    gps = good.gps_enu.copy()
    half = np.flatnonzero(good.periods == 1)[::2]
    gps[half] += np.array([60.0, -50.0, 0.0])
    gps[half[::2]] += np.array([-150.0, 90.0, 0.0])
    verdict = judge(certify(replace(good, gps_enu=gps)))
    assert verdict.level != "pass"
    assert any(f.check == "gps_residual" and f.place == "period 2017" for f in verdict.objections)


@given(st.integers(0, 10**6))
def test_a_displaced_part_shows_in_the_gps_of_neighbours(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = rng.uniform(-60, 60, (80, 3)) * [1, 1, 0.05]
    gps = places + rng.normal(0, 3.0, places.shape)
    gps[rng.permutation(80)[:4]] += rng.normal(0, 100, 3)  # scattered outliers do no harm
    fit = fit_gps(places, gps)
    assert isinstance(fit, PeriodGpsFit) and fit.local < THRESHOLDS["gps_residual"].doubtful
    part = np.argsort(np.linalg.norm(places - places[0], axis=1))[: NEIGHBOURS + 4]
    gps[part] += [40.0, 30.0, 0.0]
    fit = fit_gps(places, gps)
    assert isinstance(fit, PeriodGpsFit)
    assert fit.median < THRESHOLDS["gps_residual"].doubtful < fit.local


@pytest.mark.parametrize("seed", range(5))
def test_a_small_part_shows_by_the_direction_to_its_gps(seed: int) -> None:
    rng = np.random.default_rng(seed)
    places = np.c_[np.arange(0, 200, 8.0), rng.normal(0, 2, (25, 2))]
    gps = places + rng.normal(0, 3.0, places.shape)
    gross = rng.permutation(25)[:4]
    gps[gross] += rng.uniform(60, 300, (4, 1)) * np.eye(3)[[0, 1, 0, 1]] * [[1], [1], [-1], [-1]]
    gps[:, 2] += 80.0  # heights are not judged
    gps[rng.permutation(25)[0]] = np.nan
    assert not displaced_parts(places, gps).any()
    places[[20, 21, 22]] = places[10] + [[0, 1, 0], [1, 1, 0], [2, 1, 0]]
    gps[[20, 21, 22]] = places[20] + [90.0, 60.0, 0.0] + rng.normal(0, 3.0, (3, 3))
    assert displaced_parts(places, gps).nonzero()[0].tolist() == [20, 21, 22]
    assert not displaced_parts(places[20:22], gps[20:22]).any()


def test_parts_that_gps_places_elsewhere_belong_to_their_periods(
    good: Registered, certificate: Certificate
) -> None:
    centres = camera_centre(good.cam_from_world)
    part = np.argsort(np.linalg.norm(centres - centres[0], axis=1))[:4]
    gps = good.gps_enu.copy()
    gps[part] = centres[part] + [80.0, -60.0, 0.0]
    found = certify(replace(good, gps_enu=gps))
    named = {name for p in found.periods for name in p.elsewhere}
    assert named == {good.names[i] for i in part}
    for period in found.periods:
        assert all(good.periods[good.names.index(n)] == period.period for n in period.elsewhere)
    assert {f.level for f in judge(found).objections if f.check == "gps_part"} == {"doubtful"}
    assert not any(p.elsewhere for p in certificate.periods)


def test_loose_parts_belong_to_their_periods(small: Registered) -> None:
    names = [n for n, p in zip(small.names, small.periods, strict=True) if p == 1][:4]
    found = certify(replace(small, loose=frozenset(names)))
    assert [p.loose for p in found.periods] == [(), tuple(names)]
    (objection,) = (f for f in judge(found).objections if f.check == "loose")
    assert f"4, expected at most 0 ({names[0]} to {names[-1]})" in objection.found


def test_one_period_is_not_praised_for_an_alignment() -> None:
    made = generate_case(CaseSettings(ties=0, seed=34, periods=1))
    verdict = judge(certify(made.model))
    assert verdict.level != "fail"
    assert "of each other" not in verdict.text
