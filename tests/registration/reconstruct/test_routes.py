"""Routes on databases whose poses are known."""

import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from chronoscene.errors import RegistrationError
from chronoscene.io.pycolmap import pycolmap
from chronoscene.registration.reconstruct.routes import add_period, joint, separate
from chronoscene.scene.geometry import camera_centre

MAX_DEGREES = 0.1
MAX_SHARE = 0.002
"""Largest error of a right registration: 0.2% of the extent."""


def assert_accurate(case: Any) -> None:
    for degrees, share in case.errors(reference=0).values():
        assert degrees < MAX_DEGREES
        assert share < MAX_SHARE


def poses_of_period_0(case: Any) -> dict[str, Any]:
    return {n: pose[:3].tolist() for n, pose in case.truth.items() if case.periods[n] == 0}


@pytest.mark.parametrize("route", [joint, separate])
def test_routes_find_the_poses(make_case: Callable[..., Any], route: Any) -> None:
    case = make_case()
    result = case.run(route)
    assert result["model"]["images"] == len(case.truth)
    assert not result["is_georeferenced"]
    assert_accurate(case)


@pytest.mark.parametrize("route", [joint, separate])
def test_what_moved_does_not_drag_the_alignment(make_case: Callable[..., Any], route: Any) -> None:
    case = make_case(points=400, moved=0.35)
    result = case.run(route)
    assert result["model"]["images"] == len(case.truth)
    assert_accurate(case)


def test_positions_give_metres_and_gross_errors_are_named(make_case: Callable[..., Any]) -> None:
    case = make_case(gps=1.0)
    assert case.priors is not None
    result = case.run(separate)
    assert result["is_georeferenced"]
    wrong = sorted(case.truth)[::10]
    assert not set(wrong) & set(result["positions_used"])
    for name in wrong:
        assert any(
            re.match(rf"{name}: GPS is [45]\d\d\.\d m from its pose: not used", r)
            for r in result["remarks"]
        )
    assert_accurate(case)
    centres = camera_centre(np.stack(list(case.estimated().values())))
    extent = float(np.linalg.norm(np.ptp(centres, axis=0)))
    assert extent == pytest.approx(200.0, rel=0.02)


def test_gps_places_periods_that_share_no_match(make_case: Callable[..., Any]) -> None:
    case = make_case(cross_matches=0.0, gps=0.5)
    result = case.run(separate)
    assert result["model"]["images"] == len(case.truth)
    assert any("placed by GPS alone" in r for r in result["remarks"])
    for degrees, share in case.errors().values():
        assert degrees < 2.0
        assert share < 0.02


def test_periods_that_nothing_connects_are_left_apart(make_case: Callable[..., Any]) -> None:
    case = make_case(cross_matches=0.0)
    result = case.run(separate)
    ((left,),) = [result["left"]]
    assert len(left) == len(case.truth) // 2
    ((period,),) = [{case.periods[name] for name in left}]
    assert result["model"]["images"] == len(case.truth) // 2
    named = f"period summer {2016 + period}: {len(left)} images"
    assert f"{named}, {min(left)} to {max(left)}" in result["remarks"]
    assert f"{named} could not be placed" in result["remarks"]


def test_a_frozen_scene_gets_a_period(make_case: Callable[..., Any]) -> None:
    case = make_case()
    case.extra["poses"] = poses_of_period_0(case)
    result = case.run(add_period)
    assert result["model"]["images"] == len(case.truth)
    found = case.estimated()
    for name, pose in case.truth.items():
        if case.periods[name] == 0:
            np.testing.assert_allclose(found[name], pose, atol=1e-9)
    assert_accurate(case)


def test_a_frozen_scene_that_nothing_matches_is_refused(make_case: Callable[..., Any]) -> None:
    case = make_case(cross_matches=0.0)
    case.extra["poses"] = poses_of_period_0(case)
    with pytest.raises(RegistrationError, match="photos that match those of the scene"):
        case.run(add_period)


def test_poses_that_do_not_fit_the_photos_are_refused(make_case: Callable[..., Any]) -> None:
    case = make_case()
    poses = poses_of_period_0(case)
    shuffled = np.random.default_rng(0).permutation(list(poses)).tolist()
    case.extra["poses"] = {n: poses[m] for n, m in zip(poses, shuffled, strict=True)}
    with pytest.raises(RegistrationError, match="check that its poses belong to its images"):
        case.run(add_period)


def test_nothing_to_map_is_said(make_case: Callable[..., Any]) -> None:
    case = make_case(points=5)
    with pytest.raises(RegistrationError, match="found no pair of photos"):
        case.run(joint)
    case.extra["keep_unplaced"] = True
    with pytest.raises(RegistrationError, match="tie points align models"):
        case.run(separate)


@pytest.mark.parametrize("keep_unplaced", [pytest.param(False, marks=pytest.mark.slow), True])
def test_a_photo_that_only_the_other_period_matches_is_registered(
    make_case: Callable[..., Any], keep_unplaced: bool
) -> None:
    """With tie points, too, as long as no period waits for them."""
    case = make_case()
    case.extra["keep_unplaced"] = keep_unplaced
    with pycolmap.Database.open(str(case.database)) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
        lone, *others = sorted(n for n, p in case.periods.items() if p == 1)
        for other in others:
            database.delete_two_view_geometry(ids[lone], ids[other])
    result = case.run(separate)
    assert any("1 more images registered with the merged model" in r for r in result["remarks"])
    assert result["model"]["images"] == len(case.truth)
    assert_accurate(case)


def test_a_period_without_matches_waits_for_tie_points(make_case: Callable[..., Any]) -> None:
    case = make_case(cross_matches=0.0)
    case.extra["keep_unplaced"] = True
    result = case.run(separate)
    assert result["model"]["images"] == len(case.truth)
    assert result["left"] == []
    assert {case.periods[name] for name in result["unplaced"]} in ({0}, {1})
    assert len(result["unplaced"]) == len(case.truth) // 2
    for period in (0, 1):
        degrees, share = case.errors(reference=period)[period]
        assert degrees < MAX_DEGREES
        assert share < MAX_SHARE
